"""Commands that read and write files: a first look, calibration, training."""

from __future__ import annotations

import html
import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from . import _native
from ._arguments import flags, settings
from ._capture import Capture
from ._messages import messages, result, start
from ._sensor import Sensor
from ._source import Input, ordered


@dataclass(frozen=True)
class Look:
    """A first look at a capture, which shows itself in a notebook.

    Attributes
    ----------
    html : str
        One page: what the capture is, its mean, one instant restored.
    info : dict
        Format, light, warnings, and what `restore` would do.
    """

    html: str = field(repr=False)
    info: dict[str, Any]

    def _repr_html_(self) -> str:
        page = html.escape(self.html, quote=True)
        return f'<iframe srcdoc="{page}" style="width:100%;height:40em;border:0"></iframe>'

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the page."""
        Path(path).write_text(self.html, encoding="utf-8")


def methods() -> dict[str, str]:
    """Returns the names of all methods of `restore`, each with a line about it."""
    return dict(_native.methods())


def look(capture: Input, /, **options: object) -> Look:
    """Looks at a capture for about a second: what it is, its light, a mean, one instant restored.

    Parameters
    ----------
    capture : Capture, path or array
        As for `restore`.
    **options
        Options of ``qudi look --help``: ``sensor="swissspad2"``, ``bits=3``.

    Returns
    -------
    Look
        A page and the figures in it.

    Raises
    ------
    FormatError, ValueError, OSError
        As `restore`.
    """
    with tempfile.TemporaryDirectory(prefix="qudi-spad-") as folder:
        path, given = _file(capture, options, folder)
        page = os.path.join(folder, "look.html")
        info = result(["look", *flags(given), f"--output={page}", "--", path])
        info.pop("output", None)
        return Look(Path(page).read_text(encoding="utf-8"), info)


def calibrate(
    capture: Input,
    output: str | os.PathLike[str],
    /,
    *,
    sensor: str | Sensor | None = None,
    overwrite: bool = False,
    **options: object,
) -> Sensor:
    """Measures dark rates, hot pixels and read noise from a capture with the shutter closed.

    Parameters
    ----------
    capture : Capture, path or array
        The dark capture.
    output : path
        The sensor file (``.toml``) to write, with two maps next to it.
    sensor : str or Sensor, optional
        The sensor to start from.
    overwrite : bool
        True replaces what is there.
    **options
        Options of ``qudi calibrate --help``: ``hot="100/s"``.

    Returns
    -------
    Sensor
        The sensor of the file.

    Raises
    ------
    FormatError, SensorMismatch, ValueError, OSError
        As `restore`; also if the place is taken.
    """
    with tempfile.TemporaryDirectory(prefix="qudi-spad-") as folder:
        path, given = _file(capture, options, folder)
        if sensor is not None:
            given["sensor"] = sensor
        given["force"] = overwrite
        result(["calibrate", *flags(given), f"--output={os.fspath(output)}", "--", path])
    return Sensor.from_toml(output)


class TrainingRun:
    """A training that runs while its events are iterated over.

    Attributes
    ----------
    output : Path
        The run's folder: ``weights.safetensors``, ``metrics.jsonl``, pictures, state.
    """

    def __init__(self, arguments: list[str], output: Path) -> None:
        self.output = output
        self._arguments = arguments

    @property
    def weights(self) -> Path:
        """The weights, for ``restore(..., weights=run.weights)``."""
        return self.output / "weights.safetensors"

    def __iter__(self) -> Iterator[dict[str, Any]]:
        metrics = self.output / "metrics.jsonl"
        before = metrics.stat() if metrics.exists() else None
        seen = before.st_size if before else 0
        goes_on = "--resume" in self._arguments
        for _kind, _value in messages(start(self._arguments), patience=600.0):
            if not metrics.exists():
                continue
            with metrics.open("rb") as lines:
                end = lines.seek(0, os.SEEK_END)
                is_other = before is not None and os.fstat(lines.fileno()).st_ino != before.st_ino
                if goes_on:
                    # The steps after the last state were dropped.
                    seen = min(seen, end)
                elif end < seen or is_other:
                    # A run in place of another one writes a file of its own.
                    seen, before = 0, None
                lines.seek(seen)
                for line in lines:
                    if line.endswith(b"\n"):
                        seen += len(line)
                        yield json.loads(line)

    def run(self) -> Path:
        """Trains to the end, and returns the path of the weights."""
        for _event in self:
            pass
        return self.weights


def train(
    recipe: str | os.PathLike[str] | None,
    output: str | os.PathLike[str],
    /,
    *,
    settings: Mapping[str, object] | None = None,
    **options: object,
) -> TrainingRun:
    """Trains a network by a recipe (docs/training.md).

    Nothing happens until the run is iterated over; leaving the loop stops it, and ``resume=True`` goes on.

    Parameters
    ----------
    recipe : str, path or None
        A recipe's name ("tiny", "small", ...) or a TOML file; None with ``resume=True`` takes the run's own.
    output : path
        The run's folder.
    settings : dict, optional
        Keys of the recipe to change, as in ``{"train.steps": 100}``.
    **options
        Options of ``qudi train --help``: ``data="clips"``, ``resume=True``, ``device="auto"``.

    Returns
    -------
    TrainingRun
        An iterable of events: dicts with ``kind`` ("step" or "validation"), ``step``, ``total`` (the loss) and others,
        as in ``metrics.jsonl``.

    Raises
    ------
    ValueError, OSError
        While it is iterated over: if the recipe is impossible, or files are missing.
    """
    given = [*flags(options), *_settings(settings), f"--output={os.fspath(output)}"]
    named = [] if recipe is None else ["--", str(os.fspath(recipe))]
    return TrainingRun(["train", *given, *named], Path(output))


_settings = settings


def _file(capture: Input, options: dict[str, object], folder: str) -> tuple[str, dict[str, object]]:
    """Returns the path of a capture, which is written if it is in memory only, and its options."""
    given = dict(options)
    if isinstance(capture, (str, os.PathLike)):
        return str(os.fspath(capture)), given
    if isinstance(capture, Capture) and capture._source is None:
        return capture._path, {**capture._options, **given}
    if isinstance(capture, Capture) and capture._array is not None:
        array, given = capture._array, {**capture._options, **given}
    elif isinstance(capture, Capture):
        # A stream is read as it was opened.
        array = capture[:]
    elif isinstance(capture, Iterator):
        array = np.stack([np.asarray(frame) for frame in capture])
    else:
        array = ordered(capture, given)
    path = os.path.join(folder, "capture.npy")
    np.save(path, np.asarray(array))
    return path, given
