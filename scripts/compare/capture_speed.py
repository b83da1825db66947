# /// script
# requires-python = ">=3.10"
# dependencies = ["numpy", "photoncube==0.3.14"]
# ///
"""Measure speed and memory of qudi and photoncube, which alternately sum windows of a long packed capture.

    python scripts/compare/capture_speed.py target/release/qudi /tmp/capture.npy

Creates the capture if it does not exist: 100,000 binary frames of 256 x 512, 1.6 GB. Both
programs sum windows of 1000 frames; photoncube writes its means as PNG, qudi its sums as .npy.
The first, unmeasured round reads the file into the page cache.
"""

import multiprocessing
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

WINDOW, ROUNDS = 1000, 5


def run(command: list[str]) -> tuple[float, int]:
    """Return the wall time in seconds and the peak resident memory in KiB."""
    start = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    assert status == 0, command
    return time.perf_counter() - start, usage.ru_maxrss


def make(qudi: str, capture: Path) -> None:
    """Write 2000 simulated frames 50 times: simulating all frames takes long, and does not matter for reading."""
    with tempfile.TemporaryDirectory() as folder:
        burst = Path(folder) / "burst.npy"
        command = [qudi, "simulate", "scene:chart", "--size", "256x512", "--frames", "2000"]
        command += ["--sensor", "swissspad2", "--ppp-def", "detected", "--ppp", "0.1", "--seed", "1", "-o", str(burst)]
        subprocess.run(command, check=True)
        bits = np.load(burst)
        cube = np.lib.format.open_memmap(capture, "w+", np.uint8, (50 * len(bits), *bits.shape[1:]))
        for k in range(50):
            cube[k * len(bits) : (k + 1) * len(bits)] = bits


def main() -> None:
    qudi, capture = sys.argv[1], Path(sys.argv[2])
    if not capture.exists():
        # In a separate process: a child's peak memory includes its parent's memory.
        process = multiprocessing.Process(target=make, args=(qudi, capture))
        process.start()
        process.join()
    size = capture.stat().st_size
    photoncube = str(Path(sys.executable).parent / "photoncube")
    results: dict[str, list[tuple[float, int]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for round in range(ROUNDS + 1):
            sums = str(Path(folder) / f"sums{round}.npy")
            pngs = Path(folder) / f"png{round}"
            pngs.mkdir()
            commands = {
                "qudi": [qudi, "convert", str(capture), "-o", sums, "--sum", str(WINDOW)],
                "qudi, 1 thread": [qudi, "convert", "-j", "1", str(capture), "-o", sums + ".npy", "--sum", str(WINDOW)],
                "photoncube": [photoncube, "preview", "-i", str(capture), "--img-dir", str(pngs), "--burst-size", str(WINDOW)],
            }
            for name, command in commands.items():
                measured = run(command)
                if round > 0:
                    results.setdefault(name, []).append(measured)
    print(f"{size / 1e9:.2f} GB, windows of {WINDOW} frames, medians of {ROUNDS} rounds")
    for name, measured in results.items():
        seconds = statistics.median(t for t, _ in measured)
        memory = max(m for _, m in measured)
        print(f"{name:<16}{seconds:7.2f} s {size / 1e9 / seconds:7.2f} GB/s {memory / 1024:8.0f} MiB")


if __name__ == "__main__":
    main()
