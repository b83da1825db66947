# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "safetensors", "torch"]
# ///
"""Trains the last pre-denoiser of a network in PyTorch, on the bursts that `qudi train` keeps: the same objective, in bfloat16. All
other weights stay as they are.

    qudi train small --pack small.zip --init W.safetensors -o runs/x --bursts kept    # draws and keeps the bursts
    python scripts/reference/train_pre.py W.safetensors kept pre.safetensors --minutes 60
    qudi publish pre.safetensors -o small.safetensors

Bursts must have been drawn with the drafts of W. With `--sizes RECIPE.toml` pre-denoisers of W that are smaller than that recipe's grow
to them: what is new starts without any say. Where the recipe has two motions (`network.pre.motions`) the bursts must have them, too.
"""

import argparse
import math
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from kept import Burst, Part, kept
from mean_weights import MeanWeights
from network import PreDenoiser, laid
from torch import Tensor, nn

VARIATION, LEAST_ERROR = 0.01, 1e-4  # crates/qudi-model/src/objective.rs
WARMUP, CLIP = 200, 1.0  # configs/small.toml
SEEN = 176  # side of what is seen of bursts held back

Tensors = dict[str, Tensor]


def grown(old: Tensors, before: dict, config: dict) -> Tensors:
    """A pre-denoiser's weights in a larger one."""
    torch.manual_seed(1)
    new = PreDenoiser(config).state_dict()
    cells, few, many = config["fold"] ** 2, laid(before), laid(config)
    for name, value in new.items():
        if name not in old:
            # He's for what comes in, nothing for what goes out.
            silent = value.ndim == 1 or name.startswith("trusted_in") or "fuse" in name or "trust.out" in name
            nn.init.zeros_(value) if silent else nn.init.kaiming_uniform_(value, nonlinearity="relu")
        elif old[name].shape == value.shape:
            new[name] = old[name]
        elif name == "static_in.weight":
            # Four images, counts of the frame and its neighbours, expectations; the second motion's follow the first's.
            seen, expected = (5 + few) * cells, (5 + many) * cells
            value.zero_()[:, :seen] = old[name][:, :seen]
            value[:, expected : expected + few * cells] = old[name][:, seen:]
        elif name == "gather.weight":
            value.zero_()[:, : old[name].shape[1]] = old[name]
        else:
            raise SystemExit(f"{name} cannot grow from {tuple(old[name].shape)} to {tuple(value.shape)}")
    return new


def part_of(tensors: Tensors, prefix: str) -> Tensors:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


class Trainer(MeanWeights):
    def __init__(self, weights: str, sizes: Path | None) -> None:
        super().__init__(weights)
        before = self.about["network"]
        config = {**before, "pre": tomllib.loads(sizes.read_text())["network"]["pre"]} if sizes else before
        rounds = ["pre.", *(f"drafts.{k}." for k in range(config["pre"].get("rounds", 1) - 1))]
        for prefix in rounds:
            larger = grown(part_of(self.tensors, prefix), before, config)
            self.tensors |= {prefix + name: value for name, value in larger.items()}
        self.about["network"] = config
        if config != before:
            self.about["preset"] = None
        # It has seen no simulated measurement.
        self.tensors["pre.simulated_in.weight"].zero_()
        self.network = PreDenoiser(config)
        self.network.load_state_dict(part_of(self.tensors, "pre."))
        self.network.to(memory_format=torch.channels_last)
        self.network.simulated_in.requires_grad_(False)
        self.learn(self.network, "pre")

    def denoised(self, guide: Tensor) -> Tensor:
        nothing = torch.zeros_like(guide[:, :1])
        with torch.autocast("cpu", torch.bfloat16):
            return self.network(guide, nothing, nothing, torch.zeros(len(guide)))[0].float()

    def loss(self, guide: Tensor, truth: Tensor) -> Tensor:
        """Relative to the guide's error (crates/qudi-model/src/objective.rs)."""
        before = (guide[:, :1] - truth).square().mean((1, 2, 3), keepdim=True).clamp(min=LEAST_ERROR)
        error = (self.denoised(guide) - truth) / before.sqrt()
        variation = error.diff(dim=3).abs().mean() + error.diff(dim=2).abs().mean()
        return error.square().mean() + VARIATION * variation

    @torch.no_grad()
    def gain(self, bursts: list[Burst]) -> float:
        """Mean gain over the guide in dB, of the first, the last and the middle frame of eleven."""
        gains = []
        for burst in bursts:
            height, width = burst.truth.shape[1:]
            side = min(SEEN, height, width)
            part = burst.square((height - side) // 2, (width - side) // 2, side, slice(None, None, 5))
            guide, truth = torch.from_numpy(part.guide), torch.from_numpy(part.truth.copy())
            images = guide[:, :1], self.denoised(guide)
            before, after = ((image.clamp(0, 1) - truth).square().mean((1, 2, 3)) for image in images)
            gains.append(10 * (before / after).log10().mean().item())
        return float(np.mean(gains))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights")
    parser.add_argument("bursts", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--sizes", type=Path, help="a recipe whose pre-denoisers are larger")
    parser.add_argument("--validation", type=Path, help="bursts of other clips, kept likewise, to see how far it has come")
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--rate", type=float, default=1e-3)
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--side", type=int, default=96)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    bursts, held = kept(args.bursts)
    others = [Burst(path) for path in sorted(args.validation.glob("*.safetensors"))] if args.validation else []
    trainer = Trainer(args.weights, args.sizes)
    weights = list(trainer.learning.values())
    optimizer = torch.optim.Adam(weights, args.rate)

    def draw(step: int) -> tuple[Tensor, Tensor]:
        rng = np.random.default_rng([args.seed, step])
        parts: list[Part] = [bursts[rng.integers(len(bursts))].frame(args.side, rng) for _ in range(args.batch)]
        return tuple(torch.from_numpy(np.concatenate([getattr(p, name) for p in parts])) for name in ("guide", "truth"))

    start, step, losses, told = time.monotonic(), 0, [], -1.0
    with ThreadPoolExecutor(1) as reader:
        following = reader.submit(draw, 1)
        while (gone := (time.monotonic() - start) / 60 / args.minutes) < 1:
            if gone - told > 0.07:
                told = gone
                trainer.swap()
                gains = [f"{trainer.gain(list):.3f} dB" for list in (held, others) if list]
                trainer.swap()
                trainer.write(args.out, step)
                loss = f"{np.mean(losses):.4f}" if losses else "none yet"
                print(f"{gone * args.minutes:.1f} min, step {step}, loss {loss}, gain {', '.join(gains)}", flush=True)
                losses.clear()
                bursts, _ = kept(args.bursts)  # there may be more by now
            step += 1
            batch = following.result()
            following = reader.submit(draw, step + 1)
            for group in optimizer.param_groups:
                group["lr"] = args.rate * min(1, step / WARMUP) * 0.5 * (1 + math.cos(math.pi * gone))
            value = trainer.loss(*batch)
            optimizer.zero_grad()
            value.backward()
            nn.utils.clip_grad_norm_(weights, CLIP)
            losses.append(value.item())
            if not math.isfinite(losses[-1]):
                raise SystemExit(f"step {step}: the loss is no number; {args.out} holds the last good weights")
            optimizer.step()
            trainer.average(step)
    trainer.swap()
    print(f"step {step}, gain {', '.join(f'{trainer.gain(list):.3f} dB' for list in (held, others) if list)}")
    trainer.swap()
    trainer.write(args.out, step)


if __name__ == "__main__":
    main()
