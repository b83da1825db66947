# /// script
# requires-python = ">=3.10"
# dependencies = ["numpy"]
# ///
"""The cosine noise schedule in NumPy; writes tests/golden/cosine_schedule.in.

    python tests/golden/generate/schedule.py
"""

from pathlib import Path

import numpy as np

T, S = 1000, 0.008


def alpha_bar() -> np.ndarray:
    """Nichol and Dhariwal (2021), eq. 17, with betas clipped at 0.999."""
    t = np.arange(T + 1, dtype=np.float64) / T
    f = np.cos((t + S) / (1 + S) * np.pi / 2) ** 2
    betas = np.clip(1 - f[1:] / f[:-1], 0, 0.999)
    return np.cumprod(1 - betas)


def main() -> None:
    values = alpha_bar()
    rows = ",\n    ".join(f"({t}, {values[t]:.17e})" for t in (0, 1, 99, 250, 499, 750, 899, 990, 998, 999))
    path = Path(__file__).parents[1] / "cosine_schedule.in"
    path.write_text(f"[\n    {rows},\n]\n")


if __name__ == "__main__":
    main()
