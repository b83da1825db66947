# /// script
# requires-python = ">=3.10"
# dependencies = ["numpy"]
# ///
"""The paper's sensor in NumPy: moments of a flat scene, and the time per pixel.

Independent of qudi, written from the equations of the forward model (Poisson detections,
full well, Gaussian read noise, gain, rounding, clipping).

    python tests/golden/generate/sensor_moments.py
"""

import time

import numpy as np

QE, DARK, READ, BITS, FWC = 0.80, 1.6, 0.2, 3, 200
FULL = 2**BITS - 1


def expose(rng: np.random.Generator, image: np.ndarray, ppp: float, exposure: float) -> np.ndarray:
    """Counts of one frame; `image / exposure * ppp` photons fall on each pixel."""
    gain = 0.5 * FULL / ppp
    electrons = np.minimum(rng.poisson(QE * image * (ppp / exposure) + DARK), FWC)
    voltage = electrons + rng.normal(0.0, READ, image.shape)
    return np.clip(np.round(gain * voltage), 0, FULL).astype(np.uint16)


def main() -> None:
    rng = np.random.default_rng(1)
    flat = np.full((2048, 2048), 0.5)
    print("ppp     mean   deviation of y/7")
    for ppp in (3.25, 9.75, 19.5, 26.0):
        y = expose(rng, flat, ppp, 0.5) / FULL
        print(f"{ppp:5}  {y.mean():.4f}  {y.std():.4f}")

    size = 512
    y, x = np.mgrid[:size, :size]
    scene = ((x * 31 + y * 17) % 256 / 255.0).astype(np.float32)
    expose(rng, scene, 3.25, 0.45)
    times = []
    for _ in range(30):
        start = time.perf_counter()
        expose(rng, scene, 3.25, 0.45)
        times.append(time.perf_counter() - start)
    print(f"numpy {np.__version__}: {np.median(times) / size**2 * 1e9:.1f} ns per pixel (median of 30 frames)")


if __name__ == "__main__":
    main()
