# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy"]
# ///
"""Measure how LPIPS and the other metrics of `qudi eval` score texture that is correct except for its position.

    python scripts/convert/lpips.py weights
    python scripts/compare/texture.py path/to/qudi CLIPS weights --ppp 3.25

CLIPS is a folder of clips, each a folder of frames. The regression restores them. The script then adds to its frames

- a fraction of the ground truth's texture (the difference to its Gaussian blur of one pixel), moved by 16 pixels. It
  stands for a perfect sampler that knows the texture but not the position of its parts;
- a fraction of the true error, which gives a better estimate.

Prints means over clips and frames, as JSON.
"""

import argparse
import json
import statistics
import subprocess
import tempfile
from pathlib import Path

import numpy as np

KEYS = ("psnr_a", "ssim", "lpips_alex", "lpips_vgg", "gmsd", "ssimulacra2")
MOVED = (16, 16)


def blurred(frames: np.ndarray) -> np.ndarray:
    """Return frames after a Gaussian blur of one pixel."""
    taps = np.exp(-0.5 * np.arange(-4.0, 5.0) ** 2)
    for axis in (1, 2):
        around = [(0, 0)] * 3
        around[axis] = (4, 4)
        padded = np.pad(frames, around, "reflect")
        slices = (padded.take(range(i, i + frames.shape[axis]), axis) for i in range(9))
        frames = sum(tap * part for tap, part in zip(taps / taps.sum(), slices))
    return frames


def variants(restored: np.ndarray, truth: np.ndarray) -> dict[str, np.ndarray]:
    """Return the compared frames by name."""
    restored = restored * ((restored * truth).sum() / (restored**2).sum())
    texture = truth - blurred(truth)
    frames = {"regression": restored}
    for share in (0.25, 0.5, 1.0):
        frames[f"texture-{share}"] = restored + share * np.roll(texture, MOVED, (1, 2))
    for share in (0.1, 0.25):
        frames[f"error-{share}"] = restored + share * (truth - restored)
    return frames


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("qudi", type=Path)
    parser.add_argument("clips", type=Path)
    parser.add_argument("backbones", type=Path)
    parser.add_argument("--ppp", type=float, default=3.25)
    parser.add_argument("--frames", default="11")
    parser.add_argument("--seed", default="2")
    args = parser.parse_args()
    simulated = ["--frames", args.frames, "--ppp", str(args.ppp), "--seed", args.seed]
    quiet, light = ["--force", "--quiet"], f"{args.ppp:g}".replace(".", "_")
    with tempfile.TemporaryDirectory() as scratch:
        work = Path(scratch)
        names: list[str] = []
        for clip in sorted(path for path in args.clips.iterdir() if path.is_dir()):
            counts, truth, restored = (work / f"{name}.npy" for name in ("counts", "truth", "restored"))
            subprocess.run(
                [args.qudi, "simulate", clip, *simulated, "-o", counts, "--truth", truth, *quiet], check=True
            )
            subprocess.run([args.qudi, "restore", counts, "--steps", "0", "-o", restored, *quiet], check=True)
            pair = (np.load(path).astype(np.float64) for path in (restored, truth))
            for name, frames in variants(*pair).items():
                (work / name).mkdir(exist_ok=True)
                np.save(work / name / f"{clip.name}-ppp{light}.npy", frames.clip(0, 1).astype(np.float32))
                names += [] if name in names else [name]
        command = [args.qudi, "eval", args.clips, *simulated, "--method", "average", "--appearance", "--json"]
        command += ["--backbones", args.backbones, "--device", "cpu"]
        for name in names:
            command += ["--external", f"{name}={work / name}"]
        rows = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)["rows"]
    means = {}
    for row in rows:
        scores = [frame for clip in row["clips"] for frame in clip["frames"]]
        means[row["method"]] = {key: round(statistics.fmean(frame[key] for frame in scores), 4) for key in KEYS}
    print(json.dumps({name: means[name] for name in names}, indent=1))


if __name__ == "__main__":
    main()
