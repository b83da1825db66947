"""Restoring captures."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Literal, overload

import numpy as np
import numpy.typing as npt

from . import _native
from ._arguments import flags
from ._messages import messages, start
from ._sensor import Sensor
from ._source import Input, source_of

Frames = npt.NDArray[np.float32]
Progress = Callable[[int, "int | None"], object]


@dataclass(frozen=True)
class Result:
    """Restored frames.

    Attributes
    ----------
    frames : ndarray of float32
        ``[frames, rows, columns]``; 1 is full scale, values follow the light. Of captures behind a colour filter
        ``[frames, rows, columns, 3]``: the sensor's own red, green and blue, without white balance.
    sigma : ndarray of float32 or None
        The standard deviation of every value's error, in the unit of `frames`, from methods that predict it.
    manifest : dict
        ``settings``, on which the frames depend (method, weights, light, sensor), and ``results`` (``chi_square``,
        warnings).
    """

    frames: Frames = field(repr=False)
    sigma: Frames | None = field(repr=False)
    manifest: dict[str, Any]


def restore(
    capture: Input,
    /,
    *,
    sensor: str | Sensor | None = None,
    ppp: float | None = None,
    sum: int | str = "auto",
    method: str | None = None,
    steps: int | None = None,
    samples: int = 1,
    every: int | None = None,
    cfa: str | None = None,
    device: str = "auto",
    progress: bool | Progress | None = None,
    **options: object,
) -> Result:
    """Restores video from a capture, to the same bytes as ``qudi restore`` does.

    The interpreter is not held meanwhile, so that threads restore at once. Ctrl-C stops between tiles.

    Parameters
    ----------
    capture : Capture, path, array or iterator
        What `open` returns or opens, an array ``[frames, rows, columns]`` of counts, or an iterator of frames
        ``[rows, columns]``. Arrays may be of bool, any integer, or whole floats; uint8 may hold packed bits. Frames of
        memory maps, HDF5 data sets and Dask arrays are read one by one. Strided ones are copied, a few frames at a
        time; big-endian ones are read as they are. Tensors of PyTorch and JAX on the CPU are taken through
        ``__array__`` or ``__dlpack__``.
    sensor : str or Sensor, optional
        A preset's name, a TOML file, or a `Sensor`; by default the one that record or format name.
    ppp : float, optional
        Incident photons per pixel and frame; by default recorded, or measured from the counts.
    sum : int or "auto"
        Frames summed into one. "auto" sums binary captures without a record as light and motion allow.
    method : str, optional
        The method (docs/methods.md); by default the network where its weights know such captures, else qbp-refined.
    steps, samples : int
        Reverse steps and samples of the method "qudi-diffusion".
    every : int, optional
        Restores one frame for every so many frames of the capture.
    cfa : str, optional
        The colour filter in front of the pixels, as in "rggb@0,0", or a picture of it (docs/colour.md); by default
        the one that sensor or record name. ``gray=True`` restores luma alone, ``tonemap="srgb"`` colours for the eye.
    device : str
        "auto", "cpu", or a graphics card as in "wgpu:1".
    progress : bool or callable, optional
        True shows a bar (of tqdm, if that is installed); a callable gets the number of finished frames and of all.
    **options
        Any other option of ``qudi restore --help``: ``bits=3``, ``tile=256``, ``overlap=3``, ``seed=1``,
        ``weights="w.safetensors"``, ``exposure=0.3``.

    Returns
    -------
    Result
        Frames, their uncertainty, and what they depend on.

    Raises
    ------
    FormatError
        If it holds no counts: wrong rank, fractions, negative or missing values.
    SensorMismatch
        If the sensor, or the cameras that the weights were trained for, cannot have taken it.
    ValueError
        If options do not go together.
    OSError
        If a file cannot be read.
    """
    names = {"sensor": sensor, "ppp": ppp, "sum": sum, "method": method, "steps": steps, "samples": samples}
    run = _start(capture, {**names, "every": every, "cfa": cfa, "device": device}, options)
    frames, sigma = _Stack(), _Stack()
    shown: _Bar | None = None
    manifest: dict[str, Any] = {}
    try:
        for kind, value in messages(run):
            if kind == "start":
                size, total = _size(value)
                frames.lay_out(size, total)
                sigma.lay_out(size, total)
                shown = _Bar(progress, total)
            elif kind == "frame":
                frames.push(value)
                if shown is not None:
                    shown.update(frames.count)
            elif kind == "sigma":
                sigma.push(value)
            elif kind == "end":
                manifest = json.loads(value)
    finally:
        if shown is not None:
            shown.close()
    return Result(frames.array(), sigma.array() if sigma.count else None, manifest)


@overload
def restore_iter(capture: Input, /, *, sigma: Literal[False] = False, **options: Any) -> Iterator[Frames]: ...
@overload
def restore_iter(
    capture: Input, /, *, sigma: Literal[True], **options: Any
) -> Iterator[tuple[Frames, Frames | None]]: ...
def restore_iter(capture: Input, /, *, sigma: bool = False, **options: Any) -> Iterator[Any]:
    """Restores a capture frame by frame: each one is yielded when it is done.

    Of an iterator of frames, as of a camera, two windows of the method are awaited, no more. Memory holds as much.

    Parameters
    ----------
    capture, **options
        As for `restore`.
    sigma : bool
        True yields pairs of a frame and its uncertainty, which is None from methods that do not predict it.

    Yields
    ------
    ndarray of float32
        ``[rows, columns]``, or ``[rows, columns, 3]`` of captures behind a colour filter.

    Raises
    ------
    FormatError, SensorMismatch, ValueError, OSError
        As `restore`, at the first frame or when a frame cannot be read.
    """
    run = _start(capture, {}, options)
    size: tuple[int, int] = (0, 0)
    held: Frames | None = None
    uncertainty: Frames | None = None
    for kind, value in messages(run):
        if kind == "start":
            size, _ = _size(value)
        elif kind == "frame" and not sigma:
            yield _frame(value, size)
        elif kind == "frame":
            if held is not None:
                yield held, uncertainty
            held, uncertainty = _frame(value, size), None
        elif kind == "sigma" and sigma:
            yield held, _frame(value, size)
            held = None
    if held is not None:
        yield held, uncertainty


def _start(capture: Input, names: dict[str, object], others: dict[str, object]) -> _native.Run:
    """Starts a restoration. Names have defaults that the command line has, too."""
    options = {name: value for name, value in others.items() if name != "progress"}
    defaults = {"sum": "auto", "samples": 1, "device": "auto"}
    for name, value in names.items():
        if value is not None and value != defaults.get(name):
            options[name] = value
    path, source = source_of(capture, options)
    if options.get("sum") == "auto":
        del options["sum"]
    arguments = ["restore", *flags(options), "--output=-", "--", path]
    return start(arguments, frames=True, source=source)


def _size(start: tuple[str, int | None]) -> tuple[tuple[int, int], int | None]:
    settings, total = start
    document = json.loads(settings)
    return (document["height"], document["width"]), total


def _frame(values: bytes, size: tuple[int, int]) -> Frames:
    frame: Frames = _shaped(values, size).copy()
    return frame


def _shaped(values: bytes, size: tuple[int, int]) -> Frames:
    """Returns the values of a gray frame, or of one of three colours."""
    frame: Frames = np.frombuffer(values, np.float32)
    return frame.reshape(size if frame.size == size[0] * size[1] else (*size, 3))


class _Stack:
    """Frames that arrive one by one, in an array whose length may be unknown."""

    def __init__(self) -> None:
        self.count = 0
        self._size: tuple[int, int] = (0, 0)
        self._total: int | None = None
        self._frames: Frames | None = None
        self._more: list[Frames] = []

    def lay_out(self, size: tuple[int, int], total: int | None) -> None:
        self._size, self._total = size, total

    def push(self, values: bytes) -> None:
        frame = _shaped(values, self._size)
        if self._frames is None and self._total is not None:
            self._frames = np.empty((self._total, *frame.shape), np.float32)
        if self._frames is not None:
            self._frames[self.count] = frame
        else:
            self._more.append(frame.copy())
        self.count += 1

    def array(self) -> Frames:
        if self._frames is not None:
            return self._frames[: self.count]
        return np.stack(self._more) if self._more else np.empty((0, *self._size), np.float32)


class _Bar:
    """The progress of a restoration, shown as it is asked for."""

    def __init__(self, progress: bool | Progress | None, total: int | None) -> None:
        self._call = progress if callable(progress) else None
        self._total, self._done = total, 0
        self._bar: Any = None
        self._prints = False
        if progress is True:
            try:
                from tqdm.auto import tqdm  # type: ignore[import-untyped, unused-ignore]
            except ImportError:
                self._prints = True
            else:
                self._bar = tqdm(total=total, unit="frame")

    def update(self, done: int) -> None:
        if self._call is not None:
            self._call(done, self._total)
        if self._bar is not None:
            self._bar.update(done - self._done)
        if self._prints:
            print(f"\rrestored {done} of {self._total or '?'} frames", end="", file=sys.stderr, flush=True)
        self._done = done

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
        if self._prints:
            print(file=sys.stderr)
