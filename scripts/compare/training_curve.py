# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "safetensors", "torch"]
# ///
"""Train the refinement of `small` on single frames (its first stage) in PyTorch, to compare with `qudi train`.

    qudi train small --data DATA --pack pack.zip --bursts bursts -o run
    python scripts/compare/training_curve.py bursts/1-refinement --threads 2 --minutes 60 > curve.jsonl

`qudi train` has written the bursts to its cache. Network, initial distribution of the weights, loss, optimizer,
learning rate, batches and crops follow the recipe; convolutions use bfloat16, channels last. Prints one line per step:
its number, the seconds of training so far, and the loss, which is comparable with `loss.pre` of the run's metrics.
"""

import argparse
import json
import math
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from torch import Tensor

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests/golden/generate"))
import network  # noqa: E402

# As in qudi-train: burst_cache.rs, loss/reconstruction.rs.
BYTE_STEPS, TOTAL_VARIATION, MIN_ERROR = 32.0, 0.01, 1e-4


class Burst:
    """Return the planes of a burst as stored in its file; bytes stay bytes."""

    def __init__(self, path: Path):
        with safe_open(path, "numpy") as file:
            names = set(file.keys())
            self.images = np.stack([file.get_tensor(name) for name in ("reference", "merged", "noise_sigma")])
            count = sum(name.startswith("expected.") for name in names)
            planes = [f"standardized.{k}" for k in range(count + 1)] + [f"expected.{k}" for k in range(count)]
            self.standardized = np.stack([file.get_tensor(name) for name in planes])
            self.truth = file.get_tensor("truth")

    def crop(self, rng: np.random.Generator, side: int) -> tuple[np.ndarray, np.ndarray]:
        frames, height, width = self.truth.shape
        frame, top, left = rng.integers(frames), rng.integers(height - side + 1), rng.integers(width - side + 1)
        mirrored, flipped, turned = rng.random(3) < 0.5

        def cut(planes: np.ndarray) -> np.ndarray:
            part = planes[..., frame, top : top + side, left : left + side]
            part = part[..., ::-1] if mirrored else part
            part = part[..., ::-1, :] if flipped else part
            return np.swapaxes(part, -1, -2) if turned else part

        z = 0.5 * np.sinh(cut(self.standardized).astype(np.float32) / BYTE_STEPS)
        guide = np.concatenate([cut(self.images), z])
        return guide, cut(self.truth)[None]


def initialise(model: torch.nn.Module, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    for name, parameter in model.named_parameters():
        if parameter.dim() == 1 or name == "out.weight":
            torch.nn.init.zeros_(parameter)
        else:
            bound = math.sqrt(6 / (parameter.numel() / len(parameter)))
            torch.nn.init.uniform_(parameter, -bound, bound, generator)


def loss_of(restored: Tensor, guide: Tensor, truth: Tensor) -> Tensor:
    unit = (guide[:, :1] - truth).square().mean((1, 2, 3), keepdim=True).sqrt().clamp(min=math.sqrt(MIN_ERROR))
    error = (restored - truth) / unit
    variation = error.diff(dim=3).abs().mean() + error.diff(dim=2).abs().mean()
    return error.square().mean() + TOTAL_VARIATION * variation


def rate(train: dict, step: int) -> float:
    if step < train["warmup"]:
        return train["lr"] * (step + 1) / train["warmup"]
    place = min(1.0, (step - train["warmup"]) / max(1, train["steps"] - train["warmup"]))
    return train["min_lr"] + (train["lr"] - train["min_lr"]) * 0.5 * (1 + math.cos(math.pi * place))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bursts", type=Path, help="folder of cached bursts of the first stage")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--count", type=int, help="bursts to use [default: as in the recipe]")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    recipe = tomllib.loads((ROOT / "crates/qudi-model/recipes/small.toml").read_text())
    train, pre, fold = recipe["train"], recipe["network"], recipe["network"]["fold"]
    count = args.count or train["crops"]["bursts"]
    bursts = [Burst(path) for path in sorted(args.bursts.glob("*.safetensors"))[:count]]
    sizes = {"width": pre["width"], "blocks": pre["blocks"], "growth": pre["growth"], "neighbours": pre["neighbours"]}
    sizes |= {"motions": 2, "trust": pre["weight_channels"]}
    model = network.PreDenoiser({"fold": fold, "pre": sizes}).to(memory_format=torch.channels_last)
    initialise(model, train["seed"])
    adam = torch.optim.Adam(model.parameters())
    rng, side, batch = np.random.default_rng(train["seed"]), train["crops"]["side"], train["batch"]
    start = time.perf_counter()
    for step in range(train["steps"]):
        crops = [bursts[rng.integers(len(bursts))].crop(rng, side) for _ in range(batch)]
        guide, truth = (torch.from_numpy(np.stack(list(part))) for part in zip(*crops, strict=True))
        nothing = torch.zeros(batch, 1, side, side)
        with torch.autocast("cpu", torch.bfloat16):
            restored, _ = model(guide, nothing, nothing, torch.zeros(batch))
        loss = loss_of(restored.float(), guide, truth)
        adam.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), train["clip"])
        for group in adam.param_groups:
            group["lr"] = rate(train, step)
        adam.step()
        seconds = time.perf_counter() - start
        print(json.dumps({"step": step + 1, "seconds": round(seconds, 3), "loss": loss.item()}), flush=True)
        if seconds > 60 * args.minutes:
            break


if __name__ == "__main__":
    main()
