# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy"]
# ///
"""Compare the uncertainty that `qudi restore` predicts with the errors that it makes.

    python scripts/compare/uncertainty.py path/to/qudi CLIPS --ppp 3.25,26 --seed 2 \\
        -- --method qudi-diffusion --steps 10 --samples 8

Exposes 11 frames of every clip in the folder CLIPS, restores their middle with the options after `--`, and prints
the share of pixels whose error is within one and two sigma (0.683 and 0.954 for a normal law), and the rms of errors
and of sigma. Errors are counted after the best gain.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np


def arguments() -> tuple[argparse.Namespace, list[str]]:
    """Return the arguments, and the options of `qudi restore`."""
    end = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("qudi")
    parser.add_argument("clips", type=Path)
    parser.add_argument("--ppp", default="3.25")
    parser.add_argument("--seed", default="2")
    parser.add_argument("--side", type=int, default=128, help="side of the restored middle, in pixels")
    return parser.parse_args(sys.argv[1:end]), sys.argv[end + 1 :]


def measured(args: argparse.Namespace, options: list[str], clip: Path, ppp: str, folder: Path) -> list[float]:
    """Return the shares within one and two sigma, the rms of errors, and the rms of sigma."""
    counts, truth, restored, sigma = (folder / f"{name}.npy" for name in ("counts", "truth", "restored", "sigma"))
    common = ["--seed", args.seed, "-q", "-f"]
    expose = ["simulate", clip, "--frames", "11", "--ppp", ppp, "-o", counts, "--truth", truth]
    subprocess.run([args.qudi, *expose, *common], check=True)
    truth = np.load(truth).astype(float)
    top, left = ((length - args.side) // 2 for length in truth.shape[1:])
    crop = f"{top}:{top + args.side},{left}:{left + args.side}"
    files = ["-o", restored, "--uncertainty", sigma, "--crop", crop]
    subprocess.run([args.qudi, "restore", counts, *files, *options, *common], check=True)
    truth = truth[:, top : top + args.side, left : left + args.side]
    restored, sigma = (np.load(file).astype(float) for file in (restored, sigma))
    gain = (restored * truth).sum() / (restored**2).sum()
    error, sigma = np.abs(gain * restored - truth), gain * sigma
    shares = [(error <= k * sigma).mean() for k in (1, 2)]
    return [*shares, *(np.sqrt((x**2).mean()) for x in (error, sigma))]


def main() -> None:
    """Print a line for every clip, and the means."""
    args, options = arguments()
    clips = sorted(path for path in args.clips.iterdir() if path.is_dir() or path.suffix == ".mp4")
    print(f"{'PPP':>5}  {'clip':20}  1 sigma  2 sigma  rms error  rms sigma")
    with tempfile.TemporaryDirectory() as folder:
        for ppp in args.ppp.split(","):
            rows = []
            for clip in clips:
                rows.append(measured(args, options, clip, ppp, Path(folder)))
                print(line(ppp, clip.name, rows[-1]), flush=True)
            print(line(ppp, "mean", np.mean(rows, axis=0)), flush=True)


def line(ppp: str, name: str, values: list[float]) -> str:
    """Return one line of the table."""
    one, two, error, sigma = values
    return f"{ppp:>5}  {name:20}  {one:7.3f}  {two:7.3f}  {error:9.4f}  {sigma:9.4f}"


if __name__ == "__main__":
    main()
