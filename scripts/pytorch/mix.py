# /// script
# requires-python = ">=3.11"
# dependencies = ["safetensors", "torch"]
# ///
"""The weighted mean of weights that were trained further on different bursts (Wortsman et al. 2022, "Model soups").

    python scripts/pytorch/mix.py out.safetensors start.safetensors=0.4 one.safetensors=0.3 other.safetensors=0.3

Tensors that are the same in all files stay as they are, bit for bit.
"""

import argparse
import math
from pathlib import Path

import torch
from mean_weights import MeanWeights


def part(text: str) -> tuple[str, float]:
    path, _, share = text.rpartition("=")
    return path, float(share)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("parts", type=part, nargs="+", metavar="FILE=SHARE")
    args = parser.parse_args()
    files, shares = [MeanWeights(path) for path, _ in args.parts], [share for _, share in args.parts]
    if not math.isclose(sum(shares), 1):
        raise SystemExit(f"the shares are {sum(shares)} together: make them 1")
    first = files[0]
    if any(file.about["network"] != first.about["network"] for file in files):
        raise SystemExit("these are weights of networks of different sizes")
    first.mean = {
        name: sum(share * file.tensors[name] for share, file in zip(shares, files))
        for name, value in first.tensors.items()
        if not all(torch.equal(value, file.tensors[name]) for file in files)
    }
    first.write(args.out, first.about.get("steps", 0))


if __name__ == "__main__":
    main()
