# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "safetensors", "torch"]
# ///
"""Trains a pre-denoiser in PyTorch, in bfloat16, on bursts that `qudi train` cached, with the same loss. The last one
is trained together with the predicted uncertainty. All other weights stay as they are.

    qudi train small --pack small.zip --init W.safetensors --bursts bursts --draw-only
    python scripts/pytorch/train_pre.py W.safetensors bursts pre.safetensors --minutes 60
    qudi publish pre.safetensors -o small.safetensors

Bursts must have been drawn with the earlier stages of W, or with `network.pre.stages=1` to train its first stage
(`--first-stage`). With `--sizes RECIPE.toml`, pre-denoisers of W that are smaller than that recipe's grow to them; new
weights start without effect. Where the recipe has two alignments (`network.pre.alignments`), the bursts must have them.
"""

import argparse
import math
import sys
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from burst_cache import Burst, Part, cached_bursts
from mean_weights import MeanWeights
from torch import Tensor, nn

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests/golden/generate"))
from network import ErrorHead, PreDenoiser, aligned_neighbours, of_earlier_stages, with_former_keys  # noqa: E402

VARIATION, LEAST_ERROR = 0.01, 1e-4  # crates/qudi-train/src/loss
WARMUP, CLIP = 200, 1.0  # configs/small.toml
SEEN = 176  # side of what is seen of bursts held back
MOST = 16  # of which so many are seen

Tensors = dict[str, Tensor]


def grown(old: Tensors, before: dict, config: dict) -> Tensors:
    """A pre-denoiser's weights in a larger one."""
    torch.manual_seed(1)
    new = PreDenoiser(config).state_dict()
    cells, few, many = config["fold"] ** 2, aligned_neighbours(before), aligned_neighbours(config)
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
    def __init__(self, weights: str, sizes: Path | None, first_stage: bool = False) -> None:
        super().__init__(weights)
        before = self.about["network"]
        recipe = with_former_keys(tomllib.loads(sizes.read_text())["network"]) if sizes else before
        config = {**before, "pre": recipe["pre"]}
        rounds = ["pre.", *(f"drafts.{k}." for k in range(config["pre"].get("rounds", 1) - 1))]
        prefix = "drafts.0." if first_stage else "pre."
        for name in rounds:
            sizes_of = [before, config] if name == "pre." else [of_earlier_stages(before), of_earlier_stages(config)]
            larger = grown(part_of(self.tensors, name), *sizes_of)
            self.tensors |= {name + key: value for key, value in larger.items()}
        self.about["network"] = config
        if sizes:
            self.about["preset"] = sizes.stem if config == recipe else None
        # It has seen no simulated measurement.
        self.tensors[prefix + "simulated_in.weight"].zero_()
        self.network, self.error = PreDenoiser(of_earlier_stages(config) if first_stage else config), None
        self.network.load_state_dict(part_of(self.tensors, prefix))
        self.network.simulated_in.requires_grad_(False)
        learning = nn.ModuleDict({"drafts": nn.ModuleList([self.network])} if first_stage else {"pre": self.network})
        if config["pre"].get("error") and not first_stage:
            self.error = ErrorHead(config)
            self.error.load_state_dict(part_of(self.tensors, "error."))
            learning["error"] = self.error
        learning.to(memory_format=torch.channels_last)
        self.learn(learning)

    def denoised(self, guide: Tensor) -> tuple[Tensor, Tensor | None]:
        """Frames, and the predicted uncertainty, which changes no frame."""
        nothing = torch.zeros_like(guide[:, :1])
        with torch.autocast("cpu", torch.bfloat16):
            d, g = self.network(guide, nothing, nothing, torch.zeros(len(guide)))
            return d.float(), self.error(g.detach(), guide).float() if self.error else None

    def loss(self, guide: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
        """The loss relative to the reference estimate's error, and the negative log-likelihood of the errors.."""
        before = (guide[:, :1] - truth).square().mean((1, 2, 3), keepdim=True).clamp(min=LEAST_ERROR)
        d, sigma = self.denoised(guide)
        error = (d - truth) / before.sqrt()
        variation = error.diff(dim=3).abs().mean() + error.diff(dim=2).abs().mean()
        nll = ((d.detach() - truth).square() / (2 * sigma**2) + sigma.log()).mean() if self.error else torch.zeros(())
        return error.square().mean() + VARIATION * variation, nll

    @torch.no_grad()
    def gain(self, bursts: list[Burst]) -> float:
        """Mean gain over the guide in dB, of the first, the last and the middle frame of eleven."""
        gains = []
        for burst in bursts:
            height, width = burst.truth.shape[1:]
            side = min(SEEN, height, width)
            part = burst.square((height - side) // 2, (width - side) // 2, side, slice(None, None, 5))
            guide, truth = torch.from_numpy(part.guide), torch.from_numpy(part.truth.copy())
            images = guide[:, :1], self.denoised(guide)[0]
            before, after = ((image.clamp(0, 1) - truth).square().mean((1, 2, 3)) for image in images)
            gains.append(10 * (before / after).log10().mean().item())
        return float(np.mean(gains))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights")
    parser.add_argument("bursts", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--first-stage", "--draft", dest="first_stage", action="store_true", help="train the first pre-denoiser, not the last one")
    parser.add_argument("--sizes", type=Path, help="a recipe whose pre-denoisers are larger")
    parser.add_argument("--validation", type=Path, help="cached bursts of other clips, to follow the progress on")
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--rate", type=float, default=1e-3)
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--side", type=int, default=96)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    bursts, held = cached_bursts(args.bursts)
    held = held[:: math.ceil(len(held) / MOST)]
    others = [Burst(path) for path in sorted(args.validation.glob("*.safetensors"))] if args.validation else []
    trainer = Trainer(args.weights, args.sizes, args.first_stage)
    # Each with gradients of its own: neither shortens the other's steps.
    learning = [list(module.parameters()) for module in (trainer.network, trainer.error) if module]
    optimizer = torch.optim.Adam(trainer.learning.values(), args.rate)

    def draw(step: int) -> tuple[Tensor, Tensor]:
        rng = np.random.default_rng([args.seed, step])
        parts: list[Part] = [bursts[rng.integers(len(bursts))].frame(args.side, rng) for _ in range(args.batch)]
        return tuple(torch.from_numpy(np.concatenate([getattr(p, name) for p in parts])) for name in ("guide", "truth"))

    start, step, losses, said = time.monotonic(), 0, [], -1.0
    with ThreadPoolExecutor(1) as reader:
        following = reader.submit(draw, 1)
        while (gone := (time.monotonic() - start) / 60 / args.minutes) < 1:
            if gone - said > 0.07:
                said = gone
                trainer.swap()
                gains = [f"{trainer.gain(list):.3f} dB" for list in (held, others) if list]
                trainer.swap()
                trainer.write(args.out, step)
                loss = " and ".join(f"{value:.4f}" for value in np.mean(losses, 0)) if losses else "none yet"
                print(f"{gone * args.minutes:.1f} min, step {step}, loss {loss}, gain {', '.join(gains)}", flush=True)
                losses.clear()
                bursts, _ = cached_bursts(args.bursts)  # there may be more by now
            step += 1
            batch = following.result()
            following = reader.submit(draw, step + 1)
            for group in optimizer.param_groups:
                group["lr"] = args.rate * min(1, step / WARMUP) * 0.5 * (1 + math.cos(math.pi * gone))
            loss, nll = trainer.loss(*batch)
            optimizer.zero_grad()
            (loss + nll).backward()
            for parameters in learning:
                nn.utils.clip_grad_norm_([p for p in parameters if p.grad is not None], CLIP)
            losses.append((loss.item(), nll.item()))
            if not np.isfinite(losses[-1]).all():
                raise SystemExit(f"step {step}: the loss is no number; {args.out} holds the last good weights")
            optimizer.step()
            trainer.average(step)
    trainer.swap()
    print(f"step {step}, gain {', '.join(f'{trainer.gain(list):.3f} dB' for list in (held, others) if list)}")
    trainer.swap()
    trainer.write(args.out, step)


if __name__ == "__main__":
    main()
