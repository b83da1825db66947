"""Simulating cameras."""

from __future__ import annotations

import os
import tempfile
from typing import Any

import numpy as np
import numpy.typing as npt

from ._arguments import flags
from ._messages import result
from ._sensor import Sensor


def simulate(
    frames: npt.ArrayLike | str | os.PathLike[str],
    /,
    *,
    sensor: str | Sensor = "qudi-paper",
    ppp: float = 3.25,
    seed: int = 1,
    **options: object,
) -> tuple[npt.NDArray[Any], dict[str, Any]]:
    """Exposes a clip with a camera, to the same counts as ``qudi simulate`` does.

    Parameters
    ----------
    frames : array or path
        ``[frames, rows, columns]``: floats in which 1 is white, or uint8 or uint16 up to their full scale. Or a video,
        a folder of images, a still, or a scene as in ``"scene:text"`` (with ``frames=11, size=(256, 256)``).
    sensor : str or Sensor
        The camera.
    ppp : float
        Photons per pixel and frame, at the clip's mean.
    seed : int
        Seed of photons and noise.
    **options
        Any other option of ``qudi simulate --help``: ``sum=7``, ``instants=8``, ``truth="truth.npy"``.

    Returns
    -------
    counts : ndarray
        ``[frames, rows, columns]``, uint8 or uint16.
    record : dict
        Everything that makes the counts again: light, gain, sensor, seed.

    Raises
    ------
    ValueError
        If an option is impossible, or the array no clip.
    OSError
        If a file cannot be read or written.
    """
    with tempfile.TemporaryDirectory(prefix="qudi-spad-") as folder:
        if isinstance(frames, (str, os.PathLike)):
            clip = str(os.fspath(frames))
        else:
            clip = os.path.join(folder, "clip.npy")
            np.save(clip, _clip(frames))
        burst = os.path.join(folder, "burst.npy")
        named = {"sensor": sensor, "ppp": ppp, "seed": seed, **options}
        record = result(["simulate", *flags(named), f"--output={burst}", "--", clip])
        counts = np.load(burst)
    if record["burst"]["bitpack"]:
        counts = np.unpackbits(counts, axis=-1, count=record["burst"]["width"])
    return counts, record


def _clip(frames: npt.ArrayLike) -> npt.NDArray[Any]:
    clip = np.ascontiguousarray(np.asarray(frames))
    if clip.ndim != 3:
        raise ValueError(
            f"a clip of shape {clip.shape}\n  where: frames\n  help: give frames, rows and columns, as in clip[None]"
        )
    return clip.astype(np.float32) if clip.dtype in (np.float16, np.bool_) else clip
