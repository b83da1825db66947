"""Sensors."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from dataclasses import dataclass, field
from typing import Any

from . import _native
from ._messages import result

# Sensors that only a capture names, as files, for as long as the interpreter runs.
_files: list[tempfile.TemporaryDirectory[str]] = []


@dataclass(frozen=True)
class Sensor:
    """A camera: its response to light, with units (docs/sensors.md).

    Make one by `preset` or `from_toml`, or take the one of a capture: ``sensor=capture.sensor``.

    Attributes
    ----------
    source : str
        The preset's name, the path of the file, or the name that a capture gives.
    parameters : dict
        Everything that is known of it: ``response``, ``bits``, ``quantum_efficiency``, ``dark``, ``read_noise``,
        ``gain``, ``fps``, ...
    """

    source: str
    parameters: dict[str, Any] = field(repr=False)

    @classmethod
    def preset(cls, name: str) -> Sensor:
        """Returns the sensor of this name.

        Raises
        ------
        ValueError
            If there is none; the message lists the names.
        """
        return cls(name, json.loads(_native.sensor(name)))

    @classmethod
    def from_toml(cls, path: str | os.PathLike[str]) -> Sensor:
        """Reads a sensor from a TOML file, as `calibrate` writes it.

        Raises
        ------
        ValueError
            If no sensor can be so.
        OSError
            If the file cannot be read.
        """
        place = os.path.abspath(os.fspath(path))
        return cls(place, json.loads(_native.sensor(place)))

    @staticmethod
    def presets() -> list[str]:
        """Returns the names of all presets."""
        return [str(sensor["name"]) for sensor in result(["info", "--sensors"])]

    @property
    def name(self) -> str:
        """The short name."""
        return str(self.parameters["name"])

    @property
    def bits(self) -> int:
        """Bits of a sample of one native frame."""
        return int(self.parameters["bits"])

    @property
    def quantum_efficiency(self) -> float:
        """Detections per photon on the pixel's pitch."""
        return float(self.parameters["quantum_efficiency"])

    def to_toml(self) -> str:
        """Returns the text of a sensor file with all parameters."""
        return _native.sensor_toml(json.dumps(self.parameters))

    def __str__(self) -> str:
        return self.source


def argument(sensor: Sensor) -> str:
    """Returns a sensor as the command line takes it: a preset's name or a file's path."""
    try:
        if json.loads(_native.sensor(sensor.source)) == sensor.parameters:
            return sensor.source
    except (ValueError, OSError):
        pass
    text = sensor.to_toml()
    if not _files:
        _files.append(tempfile.TemporaryDirectory(prefix="qudi-sensors-"))
    place = os.path.join(_files[0].name, f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.toml")
    if not os.path.exists(place):
        with open(place, "x", encoding="utf-8") as file:
            file.write(text)
    return place
