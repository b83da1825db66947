# /// script
# requires-python = ">=3.10"
# dependencies = ["numpy", "scipy", "pillow", "bm3d"]
# ///
"""The `bm3d` package (non-commercial licence: only ever an oracle) and SciPy's laws beside qudi-burst.

    python tests/golden/generate/baselines.py golden tests/golden/baselines
    python tests/golden/generate/baselines.py compare target/release/examples/denoise THREADS FOLDER...
    python tests/golden/generate/baselines.py restore PHOTONS OUT

`golden` writes what crates/qudi-burst/tests compare with. `compare` denoises the top left 256 x 256
pixels of every eighth image of each folder with both programs, in turns, and prints mean PSNR and seconds.
`restore` denoises every frame of the bursts that `qudi eval --export-photons PHOTONS` wrote: generalized
Anscombe, BM3D, closed-form inverse; score it with `qudi eval --external numpy=OUT`.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from bm3d import BM3DProfile, bm3d
from scipy import stats

SIGMAS = (5, 15, 25, 35, 50)


def package(noisy, sigma, threads):
    profile = BM3DProfile()
    profile.num_threads = threads
    return bm3d(noisy.astype(np.float64), sigma, profile)


def psnr(estimate, truth):
    return float(-10 * np.log10(np.mean((np.asarray(estimate, np.float64) - truth) ** 2)))


def scene(kind, side=96):
    rng = np.random.default_rng(kind)
    y, x = np.mgrid[:side, :side]
    image = np.full((side, side), 0.4)
    for _ in range(60):
        cx, cy = rng.uniform(0, side, 2)
        radius = rng.uniform(3, 18)
        value, period, angle = rng.uniform(0.1, 0.9), rng.uniform(4, 12), rng.uniform(0, np.pi)
        wave = np.sin(2 * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / period)
        paint = value + (0.08 * wave if kind else 0)
        image = np.where((x - cx) ** 2 + (y - cy) ** 2 < radius**2, paint, image)
    return np.clip(image, 0, 1).astype(np.float32)


def golden(folder):
    folder.mkdir(parents=True, exist_ok=True)
    figures = {"bm3d": [], "binomial": [], "generalized": []}
    for kind, name in enumerate(("discs", "waves")):
        truth = scene(kind)
        noise = np.random.default_rng(10 + kind).normal(size=truth.shape).astype(np.float32)
        np.save(folder / f"{name}-truth.npy", truth)
        np.save(folder / f"{name}-noise.npy", noise)
        for sigma in SIGMAS:
            noisy = truth + np.float32(sigma / 255) * noise
            figures["bm3d"].append(
                {"image": name, "sigma": sigma, "psnr": psnr(package(noisy, sigma / 255, 1), truth)}
            )
    # Mean and variance of 2 sqrt(L + 1/2) asin sqrt((S + 3/8) / (L + 3/4)), S binomial.
    for trials in (7, 11, 77):
        for p in (0.1, 0.3, 0.5, 0.7, 0.9):
            s = np.arange(trials + 1)
            z = 2 * np.sqrt(trials + 0.5) * np.arcsin(np.sqrt((s + 0.375) / (trials + 0.75)))
            law = stats.binom.pmf(s, trials, p)
            mean = float((law * z).sum())
            variance = float((law * (z - mean) ** 2).sum())
            figures["binomial"].append({"trials": trials, "p": p, "mean": mean, "variance": variance})
    # The same of 2 sqrt(y + 3/8 + sigma^2 + 1/12), y of Poisson plus rounded Gaussian noise.
    for read_noise in (0.2, 2.0):
        for mean_electrons in (1.0, 4.2, 20.0):
            electrons = np.arange(200)
            y = np.arange(0, 400)
            upper = stats.norm.cdf((y[:, None] + 0.5 - electrons) / read_noise)
            lower = stats.norm.cdf((y[:, None] - 0.5 - electrons) / read_noise)
            lower[0] = 0
            law = (upper - lower) @ stats.poisson.pmf(electrons, mean_electrons)
            z = 2 * np.sqrt(y + 0.375 + read_noise**2 + 1 / 12)
            mean = float((law * z).sum())
            variance = float((law * (z - mean) ** 2).sum())
            figures["generalized"].append(
                {"read_noise": read_noise, "electrons": mean_electrons, "mean": mean, "variance": variance}
            )
    (folder / "figures.json").write_text(json.dumps(figures, indent=1) + "\n")


def compare(program, threads, folders):
    from PIL import Image

    for folder in folders:
        files = sorted(p for p in folder.iterdir() if p.suffix in (".png", ".jpg", ".tif", ".bmp"))[::8]
        for sigma in SIGMAS:
            rows = []
            for i, file in enumerate(files):
                truth = np.asarray(Image.open(file).convert("L"), np.float64)[:256, :256] / 255
                noise = np.random.default_rng(i).normal(size=truth.shape)
                noisy = (truth + sigma / 255 * noise).astype(np.float32)
                with tempfile.TemporaryDirectory() as scratch:
                    np.save(f"{scratch}/noisy.npy", noisy)
                    ours = subprocess.run(
                        [program, f"{scratch}/noisy.npy", str(sigma / 255), f"{scratch}/out.npy"],
                        env={**os.environ, "RAYON_NUM_THREADS": str(threads)},
                        capture_output=True, text=True, check=True,
                    )
                    estimate = np.load(f"{scratch}/out.npy")
                start = time.perf_counter()
                theirs = package(noisy, sigma / 255, threads)
                seconds = time.perf_counter() - start
                rows.append((psnr(estimate, truth), psnr(theirs, truth), float(ours.stdout), seconds))
            ours, theirs, mine, seconds = np.array(rows).T
            difference = ours - theirs
            print(
                f"| {folder.name} ({len(files)}) | {sigma} | {ours.mean():.2f} | {theirs.mean():.2f} | "
                f"{difference.mean():+.3f} | {difference.min():+.2f} to {difference.max():+.2f} | "
                f"{np.median(mine):.3f} | {np.median(seconds):.2f} | {np.median(seconds / mine):.0f} |",
                flush=True,
            )


def restore(photons, out):
    out.mkdir(parents=True, exist_ok=True)
    for file in sorted(photons.glob("*.npy")):
        record = json.loads((photons / f"{file.name}.json").read_text())
        sensor, light, gain = record["simulation"]["sensor"], record["light"], record["gain"]
        variance = sensor["read_noise"] ** 2 + 1 / (12 * gain**2)
        frames = []
        for counts in np.load(file):
            z = 2 * np.sqrt(counts / gain + 0.375 + variance)
            z = package(z / z.max(), 1 / z.max(), 0) * z.max()
            z = np.maximum(z, 2 * np.sqrt(0.375 + variance))
            root = np.sqrt(1.5)
            electrons = z**2 / 4 + root / 4 / z - 11 / 8 / z**2 + 5 / 8 * root / z**3 - 1 / 8 - variance
            photons_ = np.maximum(electrons - float(sensor["dark"]), 0) / sensor["quantum_efficiency"]
            frames.append(photons_ / light["ppp"] * light["exposure"])
        np.save(out / file.name, np.array(frames, np.float32))


if __name__ == "__main__":
    command, *arguments = sys.argv[1:]
    if command == "golden":
        golden(Path(arguments[0]))
    elif command == "compare":
        compare(arguments[0], int(arguments[1]), [Path(a) for a in arguments[2:]])
    else:
        restore(Path(arguments[0]), Path(arguments[1]))
