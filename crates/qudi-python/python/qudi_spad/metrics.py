"""Metrics of restored frames against the truth; values are clipped to [0, 1]."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from . import _native


def psnr(estimate: npt.ArrayLike, truth: npt.ArrayLike) -> float | npt.NDArray[np.float64]:
    """Returns the peak signal-to-noise ratio in dB.

    Parameters
    ----------
    estimate, truth : array
        ``[rows, columns]``, or ``[frames, rows, columns]``.

    Returns
    -------
    float or ndarray
        One value, or one a frame; 100 for equal images.

    Raises
    ------
    ValueError
        If they are of different shapes.
    """
    return _compare("psnr", estimate, truth)


def psnr_aligned(estimate: npt.ArrayLike, truth: npt.ArrayLike) -> float | npt.NDArray[np.float64]:
    """Returns the PSNR in dB after the best global gain, which counts of photons do not fix.

    Parameters and exceptions are the ones of `psnr`.
    """
    return _compare("psnr_aligned", estimate, truth)


def ssim(estimate: npt.ArrayLike, truth: npt.ArrayLike) -> float | npt.NDArray[np.float64]:
    """Returns the structural similarity with a uniform window of 7 x 7, as scikit-image does by default.

    Parameters and exceptions are the ones of `psnr`; frames smaller than the window give NaN.
    """
    return _compare("ssim", estimate, truth)


def gmsd(estimate: npt.ArrayLike, truth: npt.ArrayLike) -> float | npt.NDArray[np.float64]:
    """Returns the gradient magnitude similarity deviation: 0 for equal images, larger for worse ones.

    Parameters and exceptions are the ones of `psnr`.
    """
    return _compare("gmsd", estimate, truth)


def lpips(
    estimate: npt.ArrayLike,
    truth: npt.ArrayLike,
    *,
    net: str = "alex",
    weights: str | os.PathLike[str] | None = None,
) -> float | npt.NDArray[np.float64]:
    """Returns LPIPS, a distance that follows human judgement: 0 for equal images.

    Parameters
    ----------
    estimate, truth : array
        As for `psnr`.
    net : {"alex", "vgg"}
        The classifier whose features are compared.
    weights : path, optional
        Folder with its weights, made by ``scripts/convert/lpips.py``; by default where Burn keeps them.

    Returns
    -------
    float or ndarray
        One value, or one a frame.

    Raises
    ------
    ValueError, OSError
        If the shapes differ, or the weights are missing.
    """
    network = _lpips(f"lpips-{net}", None if weights is None else os.fspath(weights))
    return _each(network.distance, estimate, truth)


@lru_cache(maxsize=4)
def _lpips(kind: str, folder: str | None) -> _native.Lpips:
    return _native.Lpips(kind, folder)


def _compare(metric: str, estimate: npt.ArrayLike, truth: npt.ArrayLike) -> float | npt.NDArray[np.float64]:
    def one(estimate: bytes, truth: bytes, height: int) -> float:
        value = _native.compare(metric, estimate, truth, height)
        return float("nan") if value is None else value

    return _each(one, estimate, truth)


def _each(
    metric: Callable[[bytes, bytes, int], float], estimate: npt.ArrayLike, truth: npt.ArrayLike
) -> float | npt.NDArray[np.float64]:
    one, other = (np.asarray(image, np.float32) for image in (estimate, truth))
    if one.shape != other.shape or one.ndim not in (2, 3) or 0 in one.shape:
        raise ValueError(
            f"arrays of shapes {one.shape} and {other.shape}\n  where: estimate, truth"
            "\n  help: give two images, or two stacks of them, of one shape"
        )
    height = one.shape[-2]
    if one.ndim == 2:
        return metric(one.tobytes(), other.tobytes(), height)
    values: list[Any] = [metric(a.tobytes(), b.tobytes(), height) for a, b in zip(one, other)]
    return np.asarray(values, np.float64)
