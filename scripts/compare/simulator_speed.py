# /// script
# requires-python = ">=3.10"
# dependencies = ["numpy"]
# ///
"""qudi and NumPy expose the same 3-bit frames, alternating, so that both see the same machine.

    cargo build --release -p qudi-sim --example speed
    python scripts/compare/simulator_speed.py target/release/examples/speed
"""

import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests/golden/generate"))
from sensor_moments import expose  # noqa: E402

SIZE, ROUNDS = 512, 7


def numpy_ns(rng: np.random.Generator, scene: np.ndarray) -> float:
    times = []
    for _ in range(15):
        start = time.perf_counter()
        expose(rng, scene, 3.25, 0.45)
        times.append(time.perf_counter() - start)
    return statistics.median(times) / scene.size * 1e9


def main() -> None:
    y, x = np.mgrid[:SIZE, :SIZE]
    scene = ((x * 31 + y * 17) % 256 / 255.0).astype(np.float32)
    rng = np.random.default_rng(1)
    numpy_times, qudi_times = [], {}
    for _ in range(ROUNDS):
        numpy_times.append(numpy_ns(rng, scene))
        lines = subprocess.run([sys.argv[1]], capture_output=True, text=True, check=True).stdout
        for line in lines.splitlines():
            threads, ns = line.split()
            qudi_times.setdefault(int(threads), []).append(float(ns))
    base = statistics.median(numpy_times)
    print(f"numpy {np.__version__}      {base:6.2f} ns per pixel (median of {ROUNDS})")
    for threads, times in qudi_times.items():
        ns = statistics.median(times)
        ratio = statistics.median(n / q for n, q in zip(numpy_times, times))
        print(f"qudi, {threads} thread(s)  {ns:6.2f} ns per pixel   {ratio:5.1f} times as fast")


if __name__ == "__main__":
    main()
