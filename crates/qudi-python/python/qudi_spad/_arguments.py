"""Keyword arguments as flags of the command line."""

from __future__ import annotations

import os
from collections.abc import Mapping

import numpy as np

from ._sensor import Sensor, argument

Options = Mapping[str, object]


def flags(options: Options) -> list[str]:
    """Returns the flags for keyword arguments; None and False are left out."""
    arguments = []
    for name, value in options.items():
        if value is None or value is False:
            continue
        flag = "--" + name.replace("_", "-")
        arguments.append(flag if value is True else f"{flag}={_text(name, value)}")
    return arguments


def settings(values: Options | None) -> list[str]:
    """Returns the flags that set keys, as in ``{"train.steps": 100}``."""
    return [f"--set={key}={_setting(value)}" for key, value in (values or {}).items()]


def _text(name: str, value: object) -> str:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, (str, int, float)):
        return str(value)
    if isinstance(value, Sensor):
        return argument(value)
    if isinstance(value, os.PathLike):
        return str(os.fspath(value))
    if isinstance(value, (tuple, list)):
        return ("x" if name == "size" else ",").join(str(part) for part in value)
    if isinstance(value, Mapping):
        return ",".join(f"{key}={part}" for key, part in value.items())
    raise TypeError(f"`{name}` is a {type(value).__name__}, and text, a number, a path or a sequence is needed")


def _setting(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(_setting(part) for part in value)}]"
    return str(value)
