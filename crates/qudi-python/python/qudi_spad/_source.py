"""What is restored or opened: files, arrays of any kind, streams of frames."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, Union

import numpy as np

from . import _native
from ._native import FormatError

if TYPE_CHECKING:
    from ._capture import Capture

Input = Union["Capture", str, "os.PathLike[str]", Any]

# Name of arrays and streams where a file has its path.
UNNAMED = "array"


def source_of(capture: Input, options: dict[str, object]) -> tuple[str, _native.Source | None]:
    """Returns the path of a capture or what replaces it; adds the options with which it was opened."""
    from ._capture import Capture

    if isinstance(capture, Capture):
        for name, value in capture._options.items():
            options.setdefault(name, value)
        return capture._path, capture._source
    if isinstance(capture, (str, os.PathLike)):
        return str(os.fspath(capture)), None
    if isinstance(capture, Iterator):
        return UNNAMED, _stream(capture, options)
    return UNNAMED, array_source(capture, options)


def array_source(array: Any, options: dict[str, object]) -> _native.Source:
    """Makes the source of anything with a shape, a dtype and slices, whose frames are fetched when they are read."""
    array = ordered(array, options)
    shape = [int(extent) for extent in array.shape]
    if not shape:
        raise FormatError(
            "a single number is no capture\n  where: the array\n  help: give an array of frames, rows and columns"
        )

    def fetch(first: int, count: int) -> bytes:
        return np.asarray(array[first : first + count]).tobytes()

    return _native.Source.array(array.dtype.str, shape, fetch)


def ordered(array: Any, options: dict[str, object]) -> Any:
    """Returns an array with its frames first, as the option ``axes`` says, which is taken out."""
    if not (hasattr(array, "shape") and hasattr(array, "dtype") and hasattr(array, "__getitem__")):
        array = np.asarray(array)
    if not isinstance(array.dtype, np.dtype):
        # A tensor of the CPU, whose memory is shared.
        array = np.asarray(array) if hasattr(array, "__array__") else np.from_dlpack(array)
    axes = options.pop("axes", None)
    if axes is not None:
        array = np.transpose(array, _order(str(axes), len(array.shape)))
    return array


def _order(axes: str, rank: int) -> list[int]:
    if sorted(axes) != ["h", "t", "w"] or rank < 3:
        raise ValueError(
            f"axes={axes!r} of an array of {rank} axes\n  where: axes\n  help: name the three axes, as in axes='hwt'"
        )
    return [axes.index(axis) for axis in "thw"] + list(range(3, rank))


def _stream(frames: Iterator[Any], options: dict[str, object]) -> _native.Source:
    """Makes the source of an iterator of frames; the first one says size and type of all."""
    first = np.asarray(_next(frames))
    if first.ndim != 2:
        raise FormatError(
            f"a frame of shape {first.shape}\n  where: the stream\n  help: give frames of rows and columns"
        )
    if first.dtype not in (np.uint8, np.uint16, np.bool_):
        raise FormatError(
            f"a stream of {first.dtype}\n  where: the stream\n  help: give frames of uint8, uint16 or bool"
        )
    wide = first.dtype == np.uint16
    options.setdefault("format", "raw-u16" if wide else "raw-u8")
    options.setdefault("size", first.shape)
    if first.dtype == np.bool_:
        options.setdefault("bits", 1)
    waiting: list[Any] = [first]

    def fetch() -> bytes:
        frame = np.asarray(waiting.pop() if waiting else next(frames))
        if frame.shape != first.shape or frame.dtype != first.dtype:
            raise FormatError(
                f"a frame of {frame.dtype} {frame.shape} after frames of {first.dtype} {first.shape}"
                "\n  where: the stream\n  help: give frames of one size and type"
            )
        return frame.astype("<u2" if wide else np.uint8, copy=False).tobytes()

    return _native.Source.stream(fetch)


def _next(frames: Iterable[Any]) -> Any:
    for frame in frames:
        return frame
    raise FormatError("the stream holds no frame\n  where: the stream\n  help: give at least 3 frames")
