# /// script
# requires-python = ">=3.10"
# dependencies = ["numpy", "scikit-image", "scipy"]
# ///
"""PSNR and SSIM of scikit-image, and GMSD by SciPy, on small images, for crates/qudi-core/tests/metrics.rs.

    python tests/golden/generate/metrics.py tests/golden/metrics
"""

import json
import sys
from pathlib import Path

import numpy as np
from scipy.signal import convolve2d
from skimage.metrics import peak_signal_noise_ratio, structural_similarity



def gmsd(truth: np.ndarray, estimate: np.ndarray) -> float:
    """As the authors' MATLAB program (Xue et al. 2014), for images of 8 bits."""
    prewitt = np.array([[1, 0, -1]] * 3) / 3

    def gradients(image: np.ndarray) -> np.ndarray:
        # conv2(..., 'same') with a kernel of 2 x 2 looks at the next row and column.
        half = convolve2d(255 * image, np.full((2, 2), 0.25), "full")[1:, 1:][::2, ::2]
        return np.hypot(convolve2d(half, prewitt, "same"), convolve2d(half, prewitt.T, "same"))

    a, b = gradients(truth), gradients(estimate)
    return ((2 * a * b + 170) / (a * a + b * b + 170)).std(ddof=1)


out = Path(sys.argv[1])
out.mkdir(parents=True, exist_ok=True)
rng = np.random.default_rng(4)
y, x = np.mgrid[:40, :56]
scene = 0.5 + 0.3 * np.sin(x / 5.0) * np.cos(y / 7.0) + 0.2 * ((x // 8 + y // 8) % 2) - 0.1
figures = {}
for name, sigma, gain in (("fine", 0.02, 1.0), ("rough", 0.2, 0.8), ("wild", 0.6, 1.3)):
    truth = np.clip(scene, 0, 1).astype(np.float32)
    estimate = (gain * truth + sigma * rng.normal(size=truth.shape)).astype(np.float32)
    np.save(out / f"{name}-truth.npy", truth)
    np.save(out / f"{name}-estimate.npy", estimate)
    t, e = truth.astype(np.float64), np.clip(estimate, 0, 1).astype(np.float64)
    # The best gain is applied before clipping.
    raw = estimate.astype(np.float64)
    aligned = np.clip(raw * (raw * t).sum() / (raw * raw).sum(), 0, 1)
    figures[name] = {
        "psnr": peak_signal_noise_ratio(t, e, data_range=1),
        "psnr_a": peak_signal_noise_ratio(t, aligned, data_range=1),
        "ssim": structural_similarity(t, e, data_range=1),
        "ssim_g": structural_similarity(
            t, e, data_range=1, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
        ),
        "gmsd": gmsd(t, e),
    }
(out / "figures.json").write_text(json.dumps(figures, indent=1) + "\n")
