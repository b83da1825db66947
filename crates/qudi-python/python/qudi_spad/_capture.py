"""Open captures."""

from __future__ import annotations

import builtins
import json
import os
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from . import _native
from ._arguments import flags
from ._sensor import Sensor
from ._source import Input, ordered, source_of


class Capture:
    """A capture whose frames are read when they are asked for.

    It is sliced as an array is, and gives one to NumPy; ``for frame in capture`` reads frame by frame. Values are
    counts, as the file stores them: no pixel is repaired unless ``mask="auto"`` asks for it.

    Attributes
    ----------
    shape : tuple of int
        Frames, rows, columns.
    dtype : numpy.dtype
        uint8 where no count can exceed 255, else uint16.
    sensor : Sensor or None
        The sensor that took it, if the record or the format tells.
    """

    def __init__(
        self, path: str, options: dict[str, object], source: _native.Source | None = None, array: Any = None
    ) -> None:
        # The array is what is behind the source, its axes in order; none of files and streams.
        self._path, self._options, self._source, self._array = path, options, source, array
        arguments = ["restore", *flags(options), "--output=-", "--", path]
        self._native = _native.Capture(arguments, source)
        self._info: dict[str, Any] = json.loads(self._native.info())
        largest = self._info["max_count"]
        self.dtype = np.dtype(np.uint8 if largest is not None and largest < 256 else np.uint16)
        known = self._info["sensor"]
        self.sensor = None if known is None else Sensor(known["name"], known)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, rows, columns."""
        return self._native.shape()

    @property
    def ndim(self) -> int:
        """The number of axes, 3."""
        return 3

    @property
    def size(self) -> int:
        """The number of counts."""
        frames, rows, columns = self.shape
        return frames * rows * columns

    @property
    def nbytes(self) -> int:
        """Bytes of all counts in memory."""
        return self.size * self.dtype.itemsize

    def info(self) -> dict[str, Any]:
        """Returns what is known of it: format, frame rate, light, sensor, notes.

        Returns
        -------
        dict
            ``fps`` is in output frames a second, ``ppp`` in photons per pixel and frame, ``gain`` in DN per electron.
            Unknown ones are None.
        """
        return dict(self._info)

    def sum(self, frames: int) -> Capture:
        """Sums frames into one.

        Parameters
        ----------
        frames : int
            The number of frames of this capture in each frame of the other.

        Returns
        -------
        Capture
            The same capture with fewer, longer frames; nothing is read yet.

        Raises
        ------
        ValueError
            If there are not so many frames, or a sum could exceed 16 bits.
        """
        summed = int(self._info["summed"]) * frames
        return Capture(self._path, {**self._options, "sum": summed}, self._source, self._array)

    def __len__(self) -> int:
        return self.shape[0]

    def __iter__(self) -> Iterator[npt.NDArray[Any]]:
        for frame in range(len(self)):
            yield self._frame(frame)

    def __getitem__(self, key: Any) -> npt.NDArray[Any]:
        parts = key if isinstance(key, tuple) else (key,)
        if any(part is None for part in parts):
            raise IndexError("captures take no new axes: use numpy.asarray(capture) first")
        if parts and parts[0] is Ellipsis:
            parts = (*(slice(None),) * (4 - len(parts)), *parts[1:])
        first, rest = (parts[0], parts[1:]) if parts else (slice(None), ())
        if isinstance(first, (int, np.integer)):
            frames = len(self)
            if not -frames <= first < frames:
                raise IndexError(f"frame {first} of {frames}")
            return self._frame(int(first) % frames)[rest]
        numbers = np.arange(len(self))[first]
        part = self._frame(0)[rest] if rest else np.empty(self.shape[1:], self.dtype)
        chosen = np.empty((len(numbers), *part.shape), self.dtype)
        for place, number in enumerate(numbers):
            chosen[place] = self._frame(int(number))[rest]
        return chosen

    def __array__(self, dtype: npt.DTypeLike | None = None, copy: bool | None = None) -> npt.NDArray[Any]:
        if copy is False:
            raise ValueError("a capture is read from its file: a copy cannot be avoided")
        counts = self[:]
        return counts if dtype is None else counts.astype(dtype, copy=False)

    def __repr__(self) -> str:
        frames, rows, columns = self.shape
        return f"Capture({self._path!r}, {frames} frames of {rows} x {columns}, {self._info['title']})"

    def __reduce__(self) -> builtins.tuple[Any, ...]:
        if self._source is not None:
            raise TypeError("a capture of an array cannot be pickled: pickle the array")
        return Capture, (self._path, self._options)

    def _frame(self, number: int) -> npt.NDArray[Any]:
        counts = np.frombuffer(self._native.read(number), "<u2").reshape(self.shape[1:])
        # Also where the type stays: the bytes of Python cannot be written to.
        return counts.astype(self.dtype)


def open(path: Input, /, **options: object) -> Capture:
    """Opens a capture in any format, and reads nothing but what it takes to recognise it.

    Parameters
    ----------
    path : path or array
        A file or folder (docs/formats.md), or an array ``[frames, rows, columns]``, packed or not.
    **options
        What the file does not say, as ``qudi restore --help`` lists under "Reading captures": ``format="raw-u8"``,
        ``size=(240, 320)``, ``bits=3``, ``crop="2:256,0:496"``, ``start=100``, ``sum=7``, ``sensor="swissspad2"``.

    Returns
    -------
    Capture
        Counts, read when they are asked for.

    Raises
    ------
    FormatError
        If it is of no known format, or damaged.
    ValueError
        If an option does not fit it.
    OSError
        If it cannot be read.
    """
    options = dict(options)
    array = path._array if isinstance(path, Capture) else None
    if not isinstance(path, (Capture, str, os.PathLike, Iterator)):
        path = array = ordered(path, options)
    name, source = source_of(path, options)
    return Capture(name, options, source, array)


def read(path: Input, /, **options: object) -> npt.NDArray[Any]:
    """Reads a whole capture.

    Parameters
    ----------
    path, **options
        As for `open`.

    Returns
    -------
    ndarray
        Counts ``[frames, rows, columns]``, uint8 or uint16.

    Raises
    ------
    FormatError, ValueError, OSError
        As `open`.
    """
    return np.asarray(open(path, **options))
