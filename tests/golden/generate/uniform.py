"""Numbers that Python and Rust make alike, so that the golden files need not hold weights and inputs.

`uniform(name, n)` is counter-based: value `i` depends on the CRC-32 of the name and on `i` alone.
Tensors are filled in row-major order of the PyTorch layout.
"""

import math
import zlib

import numpy as np


def uniform(name: str, n: int) -> np.ndarray:
    """n float64 values in [-1, 1), multiples of 2^-23: SplitMix64's finaliser of (crc32(name), i)."""
    key = np.uint64(zlib.crc32(name.encode()))
    with np.errstate(over="ignore"):
        z = (key << np.uint64(32) | np.arange(n, dtype=np.uint64)) + np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z ^= z >> np.uint64(31)
    return (z >> np.uint64(40)).astype(np.float64) / 2**24 * 2 - 1


def parameter(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """A weight or bias: variance 1 / fan-in; norms near 1; biases small."""
    values = uniform(name, math.prod(shape)).reshape(shape)
    if len(shape) >= 2:
        values = values * math.sqrt(3 / (values.size // shape[0]))
        # The last layers of the flow nets: flows of some tenths of a pixel to some pixels.
        if name.startswith("flow.levels.") and name.endswith(".layers.4.weight"):
            values = values * 4
    elif name.endswith(".weight"):
        values = 1 + 0.2 * values
    else:
        values = 0.1 * values
    return values.astype(np.float32)


def affine(name: str, shape: tuple[int, ...], offset: float, scale: float) -> np.ndarray:
    """An input: offset + scale * uniform, in float64, rounded to float32."""
    return (offset + scale * uniform(name, math.prod(shape))).astype(np.float32).reshape(shape)


def gaussian(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Box and Muller's pairs (a, b): first and second half of uniform(name, 2n)."""
    n = math.prod(shape)
    a, b = (uniform(name, 2 * n).reshape(2, n) + 1) / 2
    values = np.sqrt(-2 * np.log(np.maximum(a, 2.0**-24))) * np.cos(2 * np.pi * b)
    return values.astype(np.float32).reshape(shape)
