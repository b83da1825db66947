# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "safetensors", "torch"]
# ///
"""Trains all of a network but its pre-denoisers in PyTorch, in bfloat16, on bursts that `qudi train` cached, with the
same loss, which is several times as fast on processors with matrix units.

    qudi train small --pack small.zip --init W.safetensors --bursts bursts --draw-only
    python scripts/pytorch/train_unet.py W.safetensors bursts unet.safetensors --minutes 60
    qudi publish unet.safetensors -o small.safetensors

Bursts must have been drawn with the earlier stages of W, and have more than one cached frame.
"""

import argparse
import math
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from burst_cache import Burst, Part, Sensor, cached_bursts
from mean_weights import MeanWeights
from torch import Tensor, nn

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests/golden/generate"))
from network import Preconditioned, Qudi  # noqa: E402
from schedule import T as TIMES  # noqa: E402
from schedule import alpha_bar  # noqa: E402

LEAST_UNIT = 0.004  # crates/qudi-train/src/loss
WARMUP, CLIP = 200, 1.0  # configs/small.toml
NOISE, SPREAD = 0.08, 0.6  # crates/qudi-model/src/diffusion/schedule.rs
SQUARE = 160  # side of what is seen of bursts held back


def earlier_time(t: int) -> int:
    """The time of the estimate before `t`: a tenth of all further, by their roots."""
    return min(round(TIMES * (math.sqrt((t + 1) / TIMES) + 0.1) ** 2) - 1, TIMES - 1)


def time_of(noise: float) -> int:
    """The time of noise of this deviation."""
    return int(np.abs(1 - alpha_bar() - noise**2).argmin())


@dataclass
class Batch:
    bursts: list[Burst]
    guide: Tensor
    truth: Tensor
    u: Tensor
    noise: Tensor
    sensor: Tensor
    times: np.ndarray
    rng: np.random.Generator

    @classmethod
    def of(cls, bursts: list[Burst], parts: list[Part], times: np.ndarray, rng: np.random.Generator) -> "Batch":
        joined = lambda name: torch.from_numpy(np.concatenate([getattr(part, name) for part in parts]))
        noise = torch.from_numpy(rng.standard_normal(joined("truth").shape, dtype=np.float32))
        sensor = torch.tensor([burst.numbers for burst in bursts], dtype=torch.float32)
        return cls(bursts, joined("guide"), joined("truth"), joined("u"), noise, sensor, times, rng)


def unknown(batch: Batch, x0: Tensor, unit: Tensor) -> Tensor:
    """Mean squared error in what one unit of the U-Net's output changes."""
    return ((x0 - (2 * batch.truth - 1)) / unit.clamp(min=LEAST_UNIT)).square().mean()


class Trainer(MeanWeights):
    def __init__(self, weights: str) -> None:
        super().__init__(weights)
        # Pre-denoisers stay as they are, and have seen no simulated measurement.
        self.tensors["pre.simulated_in.weight"].zero_()
        self.network = Qudi(self.about["network"])
        own = {name: value for name, value in self.tensors.items() if not name.startswith("drafts.")}
        self.network.load_state_dict(own)
        self.network.pre.requires_grad_(False)
        if self.about["network"]["pre"].get("error"):
            self.network.error.requires_grad_(False)
        for module in self.network.modules():
            if isinstance(module, nn.Conv2d):
                module.to(memory_format=torch.channels_last)
        self.learn(self.network)
        self.bars = torch.from_numpy(alpha_bar().astype(np.float32))

    def noisy(self, batch: Batch, times: np.ndarray) -> Tensor:
        frames = len(batch.truth) // len(times)
        bars = self.bars[times].repeat_interleave(frames)[:, None, None, None]
        return (2 * batch.truth - 1) * bars.sqrt() + batch.noise * (1 - bars).sqrt()

    def denoised(self, batch: Batch) -> tuple[Tensor, ...]:
        """Pre-denoised frames, their features, and the deviation of their errors."""
        nothing = torch.zeros_like(batch.truth)
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
            d, g = self.network.pre(batch.guide, nothing, nothing, torch.zeros(len(batch.times)))
            return d, g, self.network.errors(g, batch.guide)

    def predicted(
        self, batch: Batch, seen: tuple[Tensor, ...], times: np.ndarray, x0_prev: Tensor, u_sim: Tensor, flag: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The prediction, and what one unit of the U-Net's output changes in it."""
        frames = len(batch.truth) // len(times)
        x_t, t, (d, g, error) = self.noisy(batch, times), torch.from_numpy(times), seen
        noisy = Preconditioned(2 * d - 1, x_t, x0_prev, flag, 2 * error, t, frames)
        with torch.autocast("cpu", torch.bfloat16):
            x0, _ = self.network.correct(noisy, batch.u, u_sim, batch.guide, d, g, t, batch.sensor, frames)
        return x0.float(), noisy.unknown

    def loss(self, batch: Batch, first_pass: bool) -> Tensor:
        times, frames = batch.times, len(batch.truth) // len(batch.times)
        nothing, seen = torch.zeros_like(batch.truth), self.denoised(batch)
        before, flag = (nothing, nothing), torch.zeros(len(times))
        if first_pass and (times < TIMES - 1).any():
            earlier = np.array([earlier_time(t) for t in times])
            with torch.no_grad():
                x0 = self.predicted(batch, seen, earlier, *before, flag)[0].clamp(-1, 1).numpy()
            u_sim = np.zeros_like(x0)
            for number, (burst, t) in enumerate(zip(batch.bursts, times)):
                part = slice(number * frames, (number + 1) * frames)
                if t == TIMES - 1:
                    x0[part] = 0
                    continue
                sensor = Sensor(burst.label, 10 ** (1 - t / TIMES))
                u_sim[part] = sensor.measure((x0[part] + 1) / 2, batch.rng)[1]
            before = tuple(map(torch.from_numpy, (x0, u_sim)))
            flag = torch.from_numpy((times < TIMES - 1).astype(np.float32))
        x0, unit = self.predicted(batch, seen, times, *before, flag)
        return unknown(batch, x0, unit)

    @torch.no_grad()
    def judged(self, bursts: list[Burst], time: int, frames: int) -> str:
        """Mean gain of the prediction at `time` over the pre-denoised first frames, without any earlier estimate, and the loss."""
        judged = []
        for burst in bursts:
            rng = np.random.default_rng(1)
            batch = Batch.of([burst], [burst.square(16, 16, SQUARE, slice(frames))], np.array([time]), rng)
            nothing = torch.zeros_like(batch.truth)
            seen = self.denoised(batch)
            x0, unit = self.predicted(batch, seen, batch.times, nothing, nothing, torch.zeros(1))
            errors = [(image.clamp(0, 1) - batch.truth).square().mean().item() for image in (seen[0], (x0 + 1) / 2)]
            judged.append((10 * math.log10(errors[0] / errors[1]), unknown(batch, x0, unit).item()))
        gain, loss = np.mean(judged, 0)
        return f"{gain:.3f} dB and {loss:.4f} at {time}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights")
    parser.add_argument("bursts", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--rate", type=float, default=1.5e-3)
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--side", type=int, default=96)
    parser.add_argument("--frames", type=int, default=6, help="frames seen of each burst, one after the other")
    parser.add_argument("--start", type=float, default=0.05, help="share of bursts at the time where sampling begins")
    parser.add_argument("--first", type=float, default=0.5, help="share of batches with an earlier estimate")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    bursts, held = cached_bursts(args.bursts)
    trainer = Trainer(args.weights)
    weights = list(trainer.learning.values())
    optimizer = torch.optim.Adam(weights, args.rate)

    def draw(step: int) -> tuple[Batch, bool]:
        rng = np.random.default_rng([args.seed, step])
        drawn = [bursts[rng.integers(len(bursts))] for _ in range(args.batch)]
        first = [rng.integers(max(len(burst.truth) - args.frames, 0) + 1) for burst in drawn]
        parts = [burst.part(args.side, rng, slice(k, k + args.frames)) for burst, k in zip(drawn, first)]
        share = lambda: (chance := rng.random()) / (1 - chance)
        late = lambda: time_of(min(NOISE * share() ** SPREAD, 1))
        times = np.array([TIMES - 1 if rng.random() < args.start else late() for _ in drawn])
        return Batch.of(drawn, parts, times, rng), rng.random() < args.first

    start, step, losses, reported = time.monotonic(), 0, [], 0.0
    with ThreadPoolExecutor(1) as reader:
        following = reader.submit(draw, 1)
        while (gone := (time.monotonic() - start) / 60 / args.minutes) < 1:
            step += 1
            batch, first_pass = following.result()
            following = reader.submit(draw, step + 1)
            for group in optimizer.param_groups:
                group["lr"] = args.rate * min(1, step / WARMUP) * 0.5 * (1 + math.cos(math.pi * gone))
            value = trainer.loss(batch, first_pass)
            optimizer.zero_grad()
            value.backward()
            nn.utils.clip_grad_norm_(weights, CLIP)
            losses.append(value.item())
            if not math.isfinite(losses[-1]):
                raise SystemExit(f"step {step}: the loss is no number; {args.out} holds the last good weights")
            optimizer.step()
            trainer.average(step)
            if gone - reported > 0.2:
                reported = gone
                trainer.write(args.out, step)
                trainer.swap()
                gains = ", ".join(trainer.judged(held, time, args.frames) for time in (TIMES - 1, 150, 50, 10))
                trainer.swap()
                minutes = (time.monotonic() - start) / 60
                print(f"{minutes:.0f} min, step {step}, loss {np.mean(losses):.4f}, gain {gains}", flush=True)
                losses.clear()
    trainer.write(args.out, step)


if __name__ == "__main__":
    main()
