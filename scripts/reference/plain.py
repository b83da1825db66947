# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "pillow", "torch"]
# ///
"""A plain regression network of the size of `small`, to compare with: eleven frames in, eleven out, in one pass.

    python scripts/reference/plain.py train small.pack.zip plain.pt --steps 25000
    qudi eval VAL --frames 11 --method average --ppp 3.25,9.75,26 --export-photons photons
    python scripts/reference/plain.py restore plain.pt photons out
    qudi eval VAL --frames 11 --method qudi --ppp 3.25,9.75,26 --external plain=out

A U-Net that sees the frames of a window as channels, with neither guide nor alignment, and learns with an absolute loss, relative to the
error of the mean frame that it corrects so that every light level counts, on the clips and stills of the pack that `qudi train small --cache-only` makes. It is told sensor, light and exposure. `--ppp 3.25 3.25` teaches it one level alone.
"""

import argparse
import io
import json
import math
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor, nn

FRAMES, SIDE, BATCH = 11, 96, 8
LEAST_ERROR = 0.01  # what is dark and at rest would outweigh all else
QE, DARK, READ_NOISE, FULL_WELL, FULL_SCALE = 0.8, 1.6, 0.2, 200, 7  # configs/sensors/qudi-paper.toml


class Plain(nn.Module):
    """On folded pixels: each level two convolutions down and two up."""

    def __init__(self, widths: tuple[int, ...] = (96, 144, 208), fold: int = 2) -> None:
        super().__init__()
        self.fold = fold
        channels = (FRAMES + 2) * fold * fold
        block = lambda a, b: nn.Sequential(
            nn.Conv2d(a, b, 3, padding=1), nn.SiLU(), nn.Conv2d(b, b, 3, padding=1), nn.SiLU()
        )
        self.down = nn.ModuleList(block(a, b) for a, b in zip((channels, *widths), widths))
        self.wider = nn.ModuleList(nn.ConvTranspose2d(b, a, 2, stride=2) for a, b in zip(widths, widths[1:]))
        self.up = nn.ModuleList(block(2 * a, a) for a in widths[:-1])
        self.last = nn.Conv2d(widths[0], FRAMES * fold * fold, 3, padding=1)
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_in" if isinstance(module, nn.Conv2d) else "fan_out")
                nn.init.zeros_(module.bias)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(self, u: Tensor, told: Tensor) -> Tensor:
        """`u` [bursts, 11, height, width] linear estimates, `told` [bursts, 2]; sides multiples of eight."""
        planes = told[:, :, None, None].expand(-1, -1, *u.shape[2:])
        x = F.pixel_unshuffle(torch.cat([u, planes], 1), self.fold)
        skips = []
        for k, block in enumerate(self.down):
            x = block(F.avg_pool2d(x, 2) if k else x)
            skips.append(x)
        for wider, block, skip in reversed(list(zip(self.wider, self.up, skips[:-1]))):
            x = block(torch.cat([wider(x), skip], 1))
        return u.mean(1, keepdim=True) + F.pixel_shuffle(self.last(x), self.fold)


class Pack:
    """Clips and stills, decoded into memory."""

    def __init__(self, path: str) -> None:
        self.of: dict[str, list[tuple[list[np.ndarray], float]]] = {}
        with zipfile.ZipFile(path) as pack:
            for clip in json.loads(pack.read("index.json"))["clips"]:
                names = (f"{clip['source']}/{clip['name']}/{k:06}.png" for k in range(clip["frames"]))
                frames = [np.asarray(Image.open(io.BytesIO(pack.read(name)))) for name in names]
                self.of.setdefault(clip["source"], []).append((frames, clip["mean"]))

    def sample(self, rng: np.random.Generator) -> tuple[np.ndarray, float]:
        """Eleven clean frames and their clip's mean: as often from clips and stills as in configs/small.toml."""
        source = "clips" if rng.random() < 5 / 8 else "stills"
        frames, mean = self.of[source][rng.integers(len(self.of[source]))]
        truth = self.clip(frames, rng) if source == "clips" else self.still(frames[0], rng)
        mean = min(max(mean, 0.02), 0.95)
        most = min(1.5, 1 / max(float(truth.max()), 1e-3), 0.95 / mean)
        factor = 0.6 * (most / 0.6) ** rng.random()
        return truth * np.float32(factor), mean * factor

    @staticmethod
    def clip(frames: list[np.ndarray], rng: np.random.Generator) -> np.ndarray:
        stride = 1 + int(rng.integers(min(2, (len(frames) - 1) // (FRAMES - 1))))
        first = int(rng.integers(len(frames) - (FRAMES - 1) * stride))
        height, width = frames[0].shape
        top, left = int(rng.integers(height - SIDE + 1)), int(rng.integers(width - SIDE + 1))
        chosen = frames[first : first + (FRAMES - 1) * stride + 1 : stride]
        x = np.stack([frame[top : top + SIDE, left : left + SIDE] for frame in chosen]).astype(np.float32) / 255
        if rng.random() < 0.5:
            x = x[::-1]
        return np.ascontiguousarray(turned(x, rng))

    @staticmethod
    def still(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Panned, turned and zoomed."""
        part = min(SIDE + 64, *image.shape)
        top, left = (int(rng.integers(length - part + 1)) for length in image.shape)
        x = image[top : top + part, left : left + part].astype(np.float32) / 255
        x = torch.from_numpy(np.ascontiguousarray(turned(x[None], rng)))[None]
        angle, speed = 2 * math.pi * rng.random(), 5 * rng.random()
        turn, zoom = math.radians(1.5 * (rng.random() - 0.5)), 1 + 0.02 * (rng.random() - 0.5)
        maps = []
        for t in range(-(FRAMES // 2), FRAMES // 2 + 1):
            scale = zoom**t * SIDE / part
            cos, sin = scale * math.cos(turn * t), scale * math.sin(turn * t)
            shift = 2 * speed * t / part
            maps.append([[cos, -sin, shift * math.cos(angle)], [sin, cos, shift * math.sin(angle)]])
        grid = F.affine_grid(torch.tensor(maps), [FRAMES, 1, SIDE, SIDE], align_corners=False)
        x = x.expand(FRAMES, -1, -1, -1)
        return F.grid_sample(x, grid, "bicubic", "reflection", align_corners=False)[:, 0].clamp(0, 1).numpy()


def turned(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One of eight ways to lay a square."""
    return np.rot90(x[:, ::-1] if rng.random() < 0.5 else x, int(rng.integers(4)), (1, 2))


def gain(ppp: float) -> float:
    return 0.5 * FULL_SCALE / ppp


def counts(truth: np.ndarray, ppp: float, exposure: float, rng: np.random.Generator) -> np.ndarray:
    """Quanta Diffusion, eq. 1."""
    electrons = np.minimum(rng.poisson(QE * ppp / exposure * truth + DARK), FULL_WELL)
    read = electrons + READ_NOISE * rng.standard_normal(truth.shape)
    return np.clip(np.rint(gain(ppp) * read), 0, FULL_SCALE).astype(np.float32)


def estimate(y: Tensor, ppp: float, exposure: float) -> tuple[Tensor, Tensor]:
    """Linear estimates in image units, and what is told besides."""
    u = ((y / gain(ppp) - DARK) * exposure / (QE * ppp)).clamp(0, 2)
    return u, torch.tensor([math.log(ppp) / 3, math.log(ppp / exposure) / 3])


def batch(pack: Pack, light: tuple[float, float], rng: np.random.Generator) -> tuple[Tensor, ...]:
    """Linear estimates, what is told besides, and the truth."""
    bursts = []
    for _ in range(BATCH):
        truth, exposure = pack.sample(rng)
        ppp = light[0] * (light[1] / light[0]) ** rng.random()
        u, told = estimate(torch.from_numpy(counts(truth, ppp, exposure, rng)), ppp, exposure)
        bursts.append((u, told, torch.from_numpy(truth)))
    return tuple(torch.stack(list(part)) for part in zip(*bursts))


def train(pack: Pack, steps: int, light: tuple[float, float], rate: float, seed: int, weights: str) -> None:
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    network = Plain().to(memory_format=torch.channels_last)
    print(f"{sum(p.numel() for p in network.parameters())} parameters")
    averaged = torch.optim.swa_utils.AveragedModel(network, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(0.999))
    adam = torch.optim.Adam(network.parameters(), lr=rate)
    worker = ThreadPoolExecutor(1)
    next_batch = worker.submit(batch, pack, light, rng)
    start, recent = time.monotonic(), []
    for step in range(1, steps + 1):
        u, told, truth = next_batch.result()
        next_batch = worker.submit(batch, pack, light, rng)
        for group in adam.param_groups:
            group["lr"] = rate * min(step / 200, 0.5 + 0.5 * math.cos(math.pi * step / steps))
        mean = (u.mean(1, keepdim=True) - truth).abs().mean((1, 2, 3)).clamp(min=LEAST_ERROR)
        with torch.autocast("cpu", torch.bfloat16):
            error = (network(u, told).float() - truth).abs().mean((1, 2, 3))
        loss = (error / mean).mean()
        adam.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        adam.step()
        averaged.update_parameters(network)
        recent.append(loss.item())
        if step % 200 == 0:
            print(f"step {step}, {time.monotonic() - start:.0f} s: {np.mean(recent):.5f}", flush=True)
            recent.clear()
        if step % 2000 == 0 or step == steps:
            torch.save(averaged.module.state_dict(), weights)


@torch.no_grad()
def restore(network: nn.Module, photons: Path, out: Path) -> None:
    """All bursts of eleven frames that `qudi eval --export-photons` wrote."""
    out.mkdir(exist_ok=True)
    for path in sorted(photons.glob("*.npy")):
        light = json.loads(path.with_name(path.name + ".json").read_text())["light"]
        y = torch.from_numpy(np.load(path).astype(np.float32))
        if len(y) != FRAMES:
            raise SystemExit(f"{path}: {len(y)} frames; export with --frames {FRAMES}")
        u, told = estimate(y, light["ppp"], light["exposure"])
        height, width = y.shape[1:]
        u = F.pad(u[None], (0, -width % 8, 0, -height % 8), mode="reflect")
        x = network(u, told[None])[0, :, :height, :width].clamp(0, 1)
        np.save(out / path.name, x.numpy().astype(np.float32))


def main() -> None:
    parser = argparse.ArgumentParser()
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("train")
    one.add_argument("pack")
    one.add_argument("weights")
    one.add_argument("--steps", type=int, default=25000)
    one.add_argument("--ppp", type=float, nargs=2, default=(0.5, 30.0))
    one.add_argument("--rate", type=float, default=6e-4)
    one.add_argument("--seed", type=int, default=1)
    two = commands.add_parser("restore")
    two.add_argument("weights")
    two.add_argument("photons", type=Path)
    two.add_argument("out", type=Path)
    args = parser.parse_args()
    if args.command == "train":
        train(Pack(args.pack), args.steps, args.ppp, args.rate, args.seed, args.weights)
    else:
        network = Plain()
        network.load_state_dict(torch.load(args.weights, weights_only=True))
        restore(network.eval(), args.photons, args.out)


if __name__ == "__main__":
    main()
