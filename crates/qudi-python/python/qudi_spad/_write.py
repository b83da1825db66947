"""Writing counts and restored frames."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from . import _native
from ._arguments import flags
from ._messages import result


def write(
    path: str | os.PathLike[str],
    array: npt.ArrayLike,
    /,
    *,
    overwrite: bool = False,
    fps: float = 25.0,
    float: bool = True,
    **options: object,
) -> None:
    """Writes counts or restored frames in the format of the name; the file is complete or not there.

    Parameters
    ----------
    path : path
        Counts: ``.npy`` (bits are packed), ``.tif``, or a folder of PNG, with a record next to it. Frames: ``.npy``,
        ``.tif``, ``.gif``, ``.mp4`` (through ffmpeg), or a folder of 16-bit PNG.
    array : array
        ``[frames, rows, columns]``: whole numbers or bools are counts, floats are frames in which 1 is white. Floats of
        shape ``[frames, rows, columns, 3]`` are colours, written as they are.
    overwrite : bool
        True replaces what is there.
    fps : float
        Frames a second of ``.gif`` and ``.mp4``.
    float : bool
        False writes ``.tif`` frames with 16 bits instead of floats.
    **options
        Options of ``qudi convert --help`` for counts: ``unpacked=True``, ``bits=3``.

    Raises
    ------
    ValueError
        If the name or the array's shape fits nothing that is written.
    OSError
        If the place is taken or cannot be written.
    """
    values = np.asarray(array)
    is_colour = values.dtype.kind == "f" and values.ndim == 4 and values.shape[-1] == 3
    if not (values.ndim == 3 or is_colour) or 0 in values.shape:
        raise ValueError(
            f"an array of shape {values.shape}\n  where: {os.fspath(path)}\n  help: give frames, rows and columns"
        )
    if values.dtype.kind == "f":
        shape = (values.shape[1], values.shape[2], 3 if is_colour else 1)
        _native.write_frames(os.fspath(path), shape, _bytes(values), float=float, fps=fps, force=overwrite)
        return
    with tempfile.TemporaryDirectory(prefix="qudi-spad-") as folder:
        counts = os.path.join(folder, "counts.npy")
        # Small samples could be taken for packed bits, or for means.
        np.save(counts, values if values.dtype == np.bool_ else _words(values))
        given = flags({"force": overwrite, **options})
        result(["convert", *given, f"--output={os.fspath(path)}", "--", counts])


def _bytes(values: npt.NDArray[Any]) -> Iterator[bytes]:
    for frame in values:
        yield frame.astype(np.float32, copy=False).tobytes()


def _words(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    if values.dtype.kind not in "iu" or values.min() < 0 or values.max() > 65535:
        raise ValueError(
            f"counts of {values.dtype} from {values.min()} to {values.max()}\n  where: the array"
            "\n  help: give whole numbers from 0 to 65535"
        )
    return values.astype(np.uint16)
