# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "pillow", "safetensors", "torch"]
# ///
"""Compare LPIPS of `qudi eval` with an independent implementation in PyTorch, with the published weights.

    python scripts/convert/lpips.py weights
    python scripts/compare/lpips.py path/to/qudi weights
    cargo build -p qudi-train --example lpips_gradient
    python scripts/compare/lpips.py path/to/qudi weights target/debug/examples/lpips_gradient

Three images are compared with noisy, blurred and shifted copies. Prints both distances and their largest
difference. With the example of `qudi-train` it also prints the largest difference of the gradients of all pixels,
relative to the largest gradient. Exits with 1 if these are above 1e-4 and 1e-3.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from safetensors.numpy import load_file

SIZE = 96
POOLS = {"alexnet": {3, 6}, "vgg16": {5, 10, 17, 24}}
TAPS = {"alexnet": [0, 3, 6, 8, 10], "vgg16": [2, 7, 14, 21, 28]}


def features(net: str, weights: dict[str, torch.Tensor], x: torch.Tensor) -> list[torch.Tensor]:
    """Return the compared outputs, as in torchvision's `features` up to the last of them."""
    taken = []
    for place in sorted({int(name.split(".")[1]) for name in weights if name.startswith("features")}):
        if place in POOLS[net]:
            x = F.max_pool2d(x, 3 if net == "alexnet" else 2, 2)
        weight, bias = (weights[f"features.{place}.{kind}"] for kind in ("weight", "bias"))
        stride = 4 if net == "alexnet" and place == 0 else 1
        padding = 2 if stride == 4 else weight.shape[2] // 2
        x = F.relu(F.conv2d(x, weight, bias, stride, padding))
        if place in TAPS[net]:
            taken.append(x)
    return taken


def distance(net: str, weights: dict[str, torch.Tensor], p: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """Return LPIPS 0.1 of two gray images in [0, 1] (Zhang et al. 2018)."""
    shift = torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1)
    scale = torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1)
    sides = []
    for image in (p, q):
        x = (image.float()[None, None].expand(1, 3, -1, -1) * 2 - 1 - shift) / scale
        sides.append([f / (f.square().sum(1, keepdim=True) + 1e-10).sqrt() for f in features(net, weights, x)])
    heads = (weights[f"lin{tap}.model.1.weight"] for tap in range(5))
    return sum(F.conv2d((a - b).square(), head).mean() for a, b, head in zip(*sides, heads))


def pictures() -> np.ndarray:
    """Return three smooth textures."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:SIZE, :SIZE]
    waves = [np.sin(x / a + y / b) for a, b in ((3, 7), (5, -4), (11, 3))]
    return np.stack([0.5 + 0.3 * np.roll(wave, 5 * i, 1) * rng.uniform(0.6, 1) for i, wave in enumerate(waves)])


def gradient_difference(example: Path, folder: Path, p: np.ndarray, q: np.ndarray, work: Path) -> float:
    """Return the largest difference of the gradients of `p`, relative to the largest gradient, over both backbones."""
    worst = 0.0
    np.save(work / "p.npy", p.astype(np.float32))
    np.save(work / "q.npy", q.astype(np.float32))
    for net, term in (("alexnet", "lpips-alex"), ("vgg16", "lpips-vgg")):
        weights = {name: torch.from_numpy(value) for name, value in load_file(folder / f"{net}.safetensors").items()}
        command = [example, folder, term, work / "p.npy", work / "q.npy"]
        text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        ours = np.array(text.split(), dtype=float)[1:].reshape(p.shape)
        image = torch.from_numpy(p.astype(np.float32)).requires_grad_()
        distance(net, weights, image, torch.from_numpy(q.astype(np.float32))).backward()
        theirs = image.grad.numpy()
        off = np.abs(ours - theirs).max() / np.abs(theirs).max()
        print(f"{net:8} gradients: largest {np.abs(theirs).max():.2e}, differences up to {off:.1e} of it")
        worst = max(worst, off)
    return worst


def main() -> None:
    qudi, folder = Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve()
    rng = np.random.default_rng(4)
    truth = np.round(pictures() * 255)
    copies = truth / 255 + 0.1 * rng.standard_normal(truth.shape)
    copies[1] = F.avg_pool2d(torch.from_numpy(truth[1:2] / 255), 5, 1, 2).numpy()[0]
    copies[2] = np.roll(truth[2] / 255, 2, 1)
    copies = copies.clip(0, 1).astype(np.float32)
    with tempfile.TemporaryDirectory() as scratch:
        work = Path(scratch)
        (work / "clip").mkdir()
        for i, frame in enumerate(truth):
            Image.fromarray(frame.astype(np.uint8)).save(work / f"clip/{i}.png")
        (work / "other").mkdir()
        np.save(work / "other/clip-ppp9_75.npy", copies)
        command = [qudi, "eval", "clip", "--ppp", "9.75", "--external", "copy=other", "--method", "average"]
        command += ["--backbones", folder, "--device", "cpu", "--json"]
        text = subprocess.run(command, cwd=work, check=True, capture_output=True, text=True).stdout
    rows = {row["method"]: row for row in json.loads(text)["rows"]}
    worst = 0.0
    for net, key in (("alexnet", "lpips_alex"), ("vgg16", "lpips_vgg")):
        weights = {name: torch.from_numpy(value) for name, value in load_file(folder / f"{net}.safetensors").items()}
        for frame, scores in enumerate(rows["copy"]["clips"][0]["frames"]):
            p, q = copies[frame].astype(np.float64), truth[frame] / 255
            gain = (p * q).sum() / (p * p).sum()
            pair = (torch.from_numpy(image) for image in ((p * gain).clip(0, 1), q))
            expected = distance(net, weights, *pair).item()
            worst = max(worst, abs(scores[key] - expected))
            print(f"{net:8} frame {frame}: qudi {scores[key]:.6f}, PyTorch {expected:.6f}")
    print(f"largest difference {worst:.1e}")
    off = 0.0
    if len(sys.argv) > 3:
        with tempfile.TemporaryDirectory() as scratch:
            example = Path(sys.argv[3]).resolve()
            pairs = zip(copies, truth / 255)
            off = max(gradient_difference(example, folder, p, q, Path(scratch)) for p, q in pairs)
    sys.exit(worst > 1e-4 or off > 1e-3)


if __name__ == "__main__":
    main()
