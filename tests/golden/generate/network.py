# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "torch"]
# ///
"""The network of docs/network.md in PyTorch, a second writing of that page, and the sampling loop around it.

Modules are named as on the page, so the keys of `state_dict()` are the names of weight files.

    python tests/golden/generate/network.py info small
"""

import math
import sys
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from schedule import alpha_bar
from torch import Tensor, nn

Flows = tuple[Tensor, Tensor]
ROOT = Path(__file__).resolve().parents[3]


def load(preset: str) -> dict:
    """The [network] table of a diffusion preset, with the switches of this reference, which is also a regression."""
    config = tomllib.loads((ROOT / "crates/qudi-model/recipes" / f"{preset}.toml").read_text())["network"]
    config["pre"]["neighbours"], config["flow"]["registration"], config["unet"]["temporal"] = 0, False, False
    return config | {"reference": "none"}


def multiple(config: dict) -> int:
    """Frame sizes are multiples of this: features have three levels, whatever the U-Net has."""
    levels = max(3, len(config["unet"]["multipliers"]))
    return math.lcm(config["fold"] << levels - 1, config["flow"]["scale"] << config["flow"]["levels"] - 1)


# Operations


def conv(a: int, b: int, kernel: int, stride: int = 1, bias: bool = True) -> nn.Conv2d:
    return nn.Conv2d(a, b, kernel, stride, kernel // 2, bias=bias)


def conv3d(a: int, b: int, stride: int = 1, bias: bool = True) -> nn.Conv3d:
    return nn.Conv3d(a, b, 5, (1, stride, stride), 2, bias=bias)


def gn(channels: int) -> nn.GroupNorm:
    groups = max(g for g in range(1, 9) if channels % g == 0)
    return nn.GroupNorm(groups, channels, eps=1e-5)


def warp(x: Tensor, flow: Tensor) -> Tensor:
    """x at (column + flow_x, row + flow_y), flow in pixels of x's own grid."""
    return sampled(x, flow, "bilinear")


def warp_cubic(x: Tensor, flow: Tensor) -> Tensor:
    """The same with cubic convolution, a = -0.75."""
    return sampled(x, flow, "bicubic")


def sampled(x: Tensor, flow: Tensor, mode: str) -> Tensor:
    """x along the flow, with a mode of `grid_sample`."""
    height, width = x.shape[2:]
    columns = torch.arange(width, dtype=x.dtype, device=x.device) + flow[:, 0]
    rows = torch.arange(height, dtype=x.dtype, device=x.device)[:, None] + flow[:, 1]
    # A grid of one cell has nothing to scale by; any coordinate is clamped to 0 there.
    grid = torch.stack([columns * 2 / max(width - 1, 1) - 1, rows * 2 / max(height - 1, 1) - 1], dim=3)
    return F.grid_sample(x, grid, mode=mode, padding_mode="border", align_corners=True)


def tv_flow(reference: Tensor, neighbour: Tensor, flow: Tensor) -> Tensor:
    """TV-L1 flow of one level (Zach, Pock and Bischof 2007), from a start."""
    weight, theta, tau = 8.0, 0.3, 0.25
    p = [torch.zeros_like(flow), torch.zeros_like(flow)]
    for _ in range(4):
        warped = warp_cubic(neighbour, flow)
        padded = F.pad(warped, (1, 1, 1, 1), mode="replicate")
        gx = (padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2]) / 2
        gy = (padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]) / 2
        square = gx.square() + gy.square() + 1e-9
        rest = warped - reference - gx * flow[:, :1] - gy * flow[:, 1:]
        for _ in range(8):
            rho = rest + gx * flow[:, :1] + gy * flow[:, 1:]
            length = (rho / square).clamp(-weight * theta, weight * theta)
            v = flow - torch.cat([length * gx, length * gy], 1)
            flow = v
            for _ in range(2):
                ux, uy = torch.zeros_like(flow), torch.zeros_like(flow)
                ux[..., :-1] = flow[..., 1:] - flow[..., :-1]
                uy[..., :-1, :] = flow[..., 1:, :] - flow[..., :-1, :]
                norm = 1 + tau / theta * (ux.square() + uy.square()).sqrt()
                p = [(p[0] + tau / theta * ux) / norm, (p[1] + tau / theta * uy) / norm]
                left, up = F.pad(p[0], (1, 0))[..., :-1], F.pad(p[1], (0, 0, 1, 0))[..., :-1, :]
                flow = v + theta * (p[0] - left + p[1] - up)
    return flow


def up2(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)


def resize_flow(flow: Tensor, scale: int, target: int) -> Tensor:
    """Flow of `scale` full-resolution pixels per cell, for a grid of `target`."""
    while scale > target:
        flow, scale = up2(flow) * 2, scale // 2
    while scale < target:
        flow, scale = F.avg_pool2d(flow, 2) / 2, scale * 2
    return flow


def bursts(x: Tensor, frames: int) -> Tensor:
    """[B*N, ...] to [B, N, ...]."""
    return x.unflatten(0, (-1, frames))


def volume(x: Tensor, frames: int) -> Tensor:
    """[B*N, C, h, w] to [B, C, N, h, w], as 3-D convolutions want it."""
    return bursts(x, frames).transpose(1, 2)


def planes(x: Tensor) -> Tensor:
    """The reverse of `volume`."""
    return x.transpose(1, 2).flatten(0, 1)


# Blocks


class DenseBlock(nn.Module):
    """Residual dense block of three layers."""

    def __init__(self, width: int, growth: int):
        super().__init__()
        self.layers = nn.ModuleList(conv(width + j * growth, growth, 3) for j in range(3))
        self.fuse = conv(width + 3 * growth, width, 1)

    def forward(self, x: Tensor) -> Tensor:
        seen = x
        for layer in self.layers:
            seen = torch.cat([seen, F.relu(layer(seen))], 1)
        return x + self.fuse(seen)


def mean_around(x: Tensor, radius: int) -> Tensor:
    """Means over squares, edges repeated."""
    padded = F.pad(x, (radius,) * 4, mode="replicate")
    return F.avg_pool2d(padded, 2 * radius + 1, stride=1)


def mean_variance(sensor: Tensor, frames: int) -> Tensor:
    """Of the linear estimate at the mean light, [B*N, 1, 1, 1]."""
    variance = (10 ** (2 * sensor[:, 10])).detach().clamp(min=1e-8)
    return variance.repeat_interleave(frames)[:, None, None, None]


def aligned_neighbours(config: dict) -> int:
    """Aligned neighbours of a frame, counted once for each alignment; the per-pixel one needs an earlier stage."""
    motions, rounds = config["pre"].get("motions", 1), config["pre"].get("rounds", 1)
    return config["pre"]["neighbours"] * (motions if rounds > 1 else min(2, motions))


def of_earlier_stages(config: dict) -> dict:
    """For the pre-denoisers before the last one: they see what an only one sees."""
    return {**config, "pre": {**config["pre"], "rounds": 1}}


def guide_planes(config: dict) -> int:
    """Channels of a guide: three images, counts of the frame and of its neighbours, expectations of the neighbours."""
    return 4 + 2 * aligned_neighbours(config)


def aligned(guide: Tensor) -> Tensor:
    """Counts and expectations as the pre-denoiser sees them, [B*N, 2 K + 1, H, W]."""
    neighbours = (guide.shape[1] - 4) // 2
    seen, expected = guide[:, 3:].split([neighbours + 1, neighbours], 1)
    return torch.cat([seen.clamp(-8, 8) / 2, torch.asinh(2 * expected)], 1)


@dataclass
class Single:
    """What a network without reference estimate is given of single frames, [B*N, 1, H, W] each."""

    u: Tensor
    y: Tensor
    deviation: Tensor

    @classmethod
    def of(cls, u: Tensor, y: Tensor, sensor: Tensor) -> "Single":
        frames = len(u) // len(sensor)
        return cls(u, y, mean_variance(sensor, frames).sqrt().clamp(min=1e-3).expand_as(u))

    def __len__(self) -> int:
        return len(self.u)


def normalized_input(guide: "Tensor | Single") -> tuple[Tensor, ...]:
    """Restored image, deviation of the merged one's noise, and what of both the networks see. Without a reference
    estimate: linear estimate, deviation of its noise, counts, and no contrast."""
    if isinstance(guide, Single):
        return guide.u, guide.deviation, 2 * guide.y - 1, None, guide.deviation.log() + 3
    clean, merged, noise = guide[:, :3].split(1, 1)
    deviation = noise.clamp(min=1e-3)
    difference = ((merged - clean) / deviation).clamp(-5, 5) / 2
    contrast = torch.asinh((clean - mean_around(mean_around(clean, 4), 4)) / deviation)
    return clean, deviation, difference, contrast, deviation.log() + 3


class Trust(nn.Module):
    """Says pixel by pixel how far each neighbour is to be trusted, and merges the counts by these weights."""

    def __init__(self, config: dict):
        super().__init__()
        self.fold, width = config["fold"], config["pre"]["trust"]
        cells = self.fold**2
        self.around = conv(5 * cells, width, 3)
        self.neighbour = conv(2 * cells, width, 3, bias=False)
        self.inner = conv(width, width, 3)
        self.out = conv(width, cells, 3)

    def forward(self, frame: Tensor, seen: Tensor, expected: Tensor) -> Tensor:
        """What is seen of a frame, its folded planes [B*N, 5 f f, h, w], and counts and expectations of its neighbours
        [B*N, K, H, W]: the merged counts, how many they are, and what the neighbours have in common."""
        images, neighbours = seen.shape[:2]
        each = lambda x: x.unflatten(0, (images, neighbours))
        pairs = F.pixel_unshuffle(torch.stack([seen, expected], 2).flatten(0, 1), self.fold)
        around = self.around(frame).repeat_interleave(neighbours, 0)
        hidden = F.relu(self.inner(F.relu(self.neighbour(pairs) + around)))
        weight = each(torch.sigmoid(self.out(hidden)))
        own, others = frame[:, -self.fold**2 :], each(pairs[:, : self.fold**2])
        merged = (own + (weight * others).sum(1)) / (1 + weight.square().sum(1)).sqrt()
        return torch.cat([merged, (1 + weight.sum(1)).log(), each(hidden).mean(1)], 1)


class PreDenoiser(nn.Module):
    def __init__(self, config: dict):
        super().__init__()
        self.fold = config["fold"]
        cells, pre = self.fold**2, config["pre"]
        self.neighbours, width = aligned_neighbours(config), pre["width"]
        single = config.get("reference") == "none"
        self.static_in = conv((3 if single else guide_planes(config) + 1) * cells, width, 3)
        if pre.get("trust"):
            self.trust = Trust(config)
            self.trusted_in = conv(2 * cells + pre["trust"], width, 3, bias=False)
        self.simulated_in = conv(2 * cells + 1, width, 3, bias=False)
        self.blocks = nn.ModuleList(DenseBlock(width, pre["growth"]) for _ in range(pre["blocks"]))
        self.gather = conv(pre["blocks"] * width, width, 1)
        self.spread = conv(width, width, 3)
        self.out = conv(width, cells, 3)

    def prepare(self, guide: Tensor) -> Tensor:
        """What no simulated measurement changes."""
        clean, _, difference, contrast, level = normalized_input(guide)
        if isinstance(guide, Single):
            return self.static_in(F.pixel_unshuffle(torch.cat([2 * clean - 1, difference, level], 1), self.fold))
        planes = [difference, contrast, 2 * clean - 1, level, aligned(guide)]
        static = F.pixel_unshuffle(torch.cat(planes, 1), self.fold)
        s = self.static_in(static)
        if hasattr(self, "trust"):
            seen, expected = planes[4].split([self.neighbours + 1, self.neighbours], 1)
            s = s + self.trusted_in(self.trust(static[:, : 5 * self.fold**2], seen[:, 1:], expected))
        return s

    def forward(
        self, guide: Tensor, y_sim: Tensor, u_sim: Tensor, flag: Tensor
    ) -> tuple[Tensor, Tensor]:
        clean, deviation, *_ = normalized_input(guide)
        s = self.prepare(guide)
        simulated = F.pixel_unshuffle(torch.cat([y_sim, u_sim], 1), self.fold)
        frames = len(guide) // len(flag)
        plane = flag.to(s).repeat_interleave(frames)[:, None, None, None].expand(-1, 1, *s.shape[2:])
        s = s + self.simulated_in(torch.cat([simulated, plane], 1))
        x, outputs = s, []
        for block in self.blocks:
            x = block(x)
            outputs.append(x)
        g = self.spread(self.gather(torch.cat(outputs, 1))) + s
        factor = 1 if isinstance(guide, Single) else 0.3
        return clean + factor * deviation * F.pixel_shuffle(self.out(g), self.fold), g


class ErrorHead(nn.Module):
    def __init__(self, config: dict):
        super().__init__()
        width, self.fold = config["pre"]["width"], config["fold"]
        self.enter = conv(width, width // 2, 3)
        self.out = conv(width // 2, self.fold**2, 3)

    def forward(self, g: Tensor, guide: Tensor) -> Tensor:
        ratio = self.out(F.relu(self.enter(g))).clamp(-5, 3).exp()
        return 0.3 * normalized_input(guide)[1] * F.pixel_shuffle(ratio, self.fold)


class Features(nn.Module):
    """The two strided layers; the first differs."""

    def __init__(self, a: int, b: int, c: int):
        super().__init__()
        self.half = conv3d(a, b, 2)
        self.quarter = conv3d(b, c, 2)

    def rest(self, first: Tensor) -> list[Tensor]:
        # `self.half` would be nn.Module's own method.
        second = F.relu(self._modules["half"](first))
        return [planes(x) for x in (first, second, F.relu(self.quarter(second)))]


class Low(Features):
    """Features of what was measured and of the pre-denoised frames."""

    def __init__(self, config: dict):
        widths = config["features"]["low"]
        super().__init__(*widths)
        self.fold = config["fold"]
        self.static_in = conv3d(self.fold**2, widths[0])
        self.moving_in = conv3d(2 * self.fold**2, widths[0], bias=False)

    def forward(self, u: Tensor, u_sim: Tensor, d: Tensor, frames: int) -> list[Tensor]:
        static = volume(F.pixel_unshuffle(u, self.fold), frames)
        moving = volume(F.pixel_unshuffle(torch.cat([u_sim, d], 1), self.fold), frames)
        return self.rest(F.relu(self.static_in(static) + self.moving_in(moving)))


class High(Features):
    """Features of the diffusion's own images."""

    def __init__(self, config: dict):
        widths = config["features"]["high"]
        super().__init__(*widths)
        self.fold = config["fold"]
        self.first = conv3d(2 * self.fold**2, widths[0])

    def forward(self, residual: Tensor, earlier: Tensor, frames: int) -> list[Tensor]:
        moving = F.pixel_unshuffle(torch.cat([residual, earlier], 1), self.fold)
        return self.rest(F.relu(self.first(volume(moving, frames))))


class FlowLevel(nn.Module):
    def __init__(self, widths: list[int]):
        super().__init__()
        sizes = [4, *widths, 2]
        self.layers = nn.ModuleList(conv(a, b, 7) for a, b in zip(sizes, sizes[1:]))

    def forward(self, x: Tensor) -> Tensor:
        for layer in self.layers[:-1]:
            x = F.relu(layer(x))
        return self.layers[-1](x)


@torch.no_grad()
def lucas_kanade(reference: Tensor, neighbour: Tensor, start: Tensor, prior: Tensor) -> Tensor:
    """How much further than `start` to look, [pairs, 2, h, w]."""
    motion = torch.zeros_like(start)
    for _ in range(3):
        warped = warp(neighbour, start + motion)
        middle = F.pad((reference + warped) / 2, (1, 1, 1, 1), mode="replicate")
        a = (middle[:, :, 1:-1, 2:] - middle[:, :, 1:-1, :-2]) / 2
        b = (middle[:, :, 2:, 1:-1] - middle[:, :, :-2, 1:-1]) / 2
        e = reference - warped + a * motion[:, :1] + b * motion[:, 1:]
        aa, ab, bb, ae, be = (mean_around(x, 4) for x in (a * a, a * b, b * b, a * e, b * e))
        matrix = torch.stack([aa + prior, ab, ab, bb + prior], -1).unflatten(-1, (2, 2))
        solved = torch.linalg.solve(matrix[:, 0], torch.stack([ae, be], -1)[:, 0])
        motion = solved.permute(0, 3, 1, 2).clamp(-3, 3)
    return mean_around(motion, 2)


class Flow(nn.Module):
    def __init__(self, config: dict):
        super().__init__()
        flow = config["flow"]
        self.scale, self.pyramid = flow["scale"], flow["levels"]
        self.registration = flow.get("registration", True)
        self.contrast = flow.get("inputs", "images") == "contrast"
        self.levels = nn.ModuleList(FlowLevel(flow["widths"]) for _ in range(flow["networks"]))

    def forward(self, d: Tensor, clean: Tensor, variance: Tensor, frames: int) -> Flows:
        """to_next and to_prev, [B*N, 2, H/scale, W/scale]; `variance` [B*N, 1, 1, 1]."""
        pyramid = [F.avg_pool2d(torch.cat([d, clean], 1), self.scale)]
        for _ in range(1, self.pyramid):
            pyramid.append(F.avg_pool2d(pyramid[-1], 2))
        # Both directions in one batch: frames 0..N-1 look ahead, frames 1..N look back.
        ahead_back = lambda x, y: torch.cat([x[:, :-1], y[:, 1:]], 1).flatten(0, 1)
        v = bursts(variance, frames)
        prior = 0.005 * ahead_back(v, v)
        flow = torch.zeros(len(prior), 2, *pyramid[-1].shape[2:], dtype=d.dtype)
        skipped = self.pyramid - len(self.levels)
        for j in reversed(range(self.pyramid)):
            x = bursts(pyramid[j], frames)
            reference = ahead_back(x, x)
            neighbour = torch.cat([x[:, 1:], x[:, :-1]], 1).flatten(0, 1)
            if j < self.pyramid - 1:
                flow = up2(flow) * 2
            if self.registration:
                flow = flow + lucas_kanade(reference[:, 1:], neighbour[:, 1:], flow, prior)
            if j >= skipped:
                images = self.images(reference[:, :1], warp(neighbour[:, :1], flow))
                flow = flow + self.levels[j - skipped](torch.cat([*images, flow], 1)) / 10
        ahead, back = bursts(flow, 2 * (frames - 1)).chunk(2, 1)
        nothing = torch.zeros_like(ahead[:, :1])
        return torch.cat([ahead, nothing], 1).flatten(0, 1), torch.cat([nothing, back], 1).flatten(0, 1)

    def images(self, reference: Tensor, warped: Tensor) -> tuple[Tensor, Tensor]:
        if not self.contrast:
            return 4 * (reference - 0.5), 4 * (warped - 0.5)
        detail = reference - mean_around(reference, 2)
        contrast = (mean_around(detail**2, 4) + 0.05**2).sqrt()
        return detail / contrast, 2 * (warped - reference) / contrast


class Cell(nn.Module):
    """One set of weights for both sweeps over the frames."""

    def __init__(self, width: int, growth: int):
        super().__init__()
        self.join = conv(2 * width, width, 1)
        self.block = DenseBlock(width, growth)
        self.leave = conv(3 * width, width, 1)

    def step(self, e: Tensor, h: Tensor) -> Tensor:
        return self.block(F.relu(self.join(torch.cat([e, h], 1))))

    def forward(self, e: Tensor, to_next: Tensor, to_prev: Tensor, frames: int) -> Tensor:
        x, ahead, back = (bursts(z, frames) for z in (e, to_next, to_prev))
        forward: list[Tensor] = []
        for i in range(frames):
            before = warp(forward[-1], back[:, i]) if forward else torch.zeros_like(x[:, 0])
            forward.append(self.step(x[:, i], before))
        backward: list[Tensor] = []
        for i in reversed(range(frames)):
            after = warp(backward[-1], ahead[:, i]) if backward else torch.zeros_like(x[:, 0])
            backward.append(self.step(x[:, i], after))
        both = [torch.stack(h, 1).flatten(0, 1) for h in (forward, backward[::-1])]
        return F.relu(self.leave(torch.cat([*both, e], 1)))


class Fusion(nn.Module):
    def __init__(self, config: dict):
        super().__init__()
        fusion, features = config["fusion"], config["features"]
        self.fold, self.scale, self.level = config["fold"], config["flow"]["scale"], fusion["level"]
        widths = fusion["widths"]
        inputs = [a + b for a, b in zip(features["low"], features["high"])]
        inputs[0] += config["pre"]["width"]
        for k in range(self.level + 1, 3):
            inputs[k] += widths[k - 1]
        self.enter = nn.ModuleList(conv(a, b, 1) for a, b in zip(inputs, widths))
        self.align = nn.ModuleList(conv(3 * widths[k], widths[k], 3) for k in range(self.level))
        self.cell = Cell(widths[self.level], fusion["growth"])

    def forward(self, low: list[Tensor], high: list[Tensor], g: Tensor, flows: Flows, frames: int) -> list[Tensor]:
        fused: list[Tensor] = []
        for k, enter in enumerate(self.enter):
            inputs = [low[k], high[k]]
            if k == 0:
                inputs.append(g)
            if k > self.level:
                inputs.append(F.avg_pool2d(fused[-1], 2))
            e = F.relu(enter(torch.cat(inputs, 1)))
            if k <= self.level:
                to_next, to_prev = (resize_flow(flow, self.scale, self.fold << k) for flow in flows)
                join = self.cell if k == self.level else partial(self.aligned, k)
                e = join(e, to_next, to_prev, frames)
            fused.append(e)
        return fused

    def aligned(self, k: int, e: Tensor, to_next: Tensor, to_prev: Tensor, frames: int) -> Tensor:
        x = bursts(e, frames)
        # Past the ends the neighbour is the frame itself; its flow is zero there.
        after = torch.cat([x[:, 1:], x[:, -1:]], 1).flatten(0, 1)
        before = torch.cat([x[:, :1], x[:, :-1]], 1).flatten(0, 1)
        return F.relu(self.align[k](torch.cat([e, warp(after, to_next), warp(before, to_prev)], 1)))


def sinusoids(t: Tensor, size: int, dtype: torch.dtype) -> Tensor:
    """[B, size]; angles in float64, for at t near 1000 float32 angles are off by 3e-5."""
    j = torch.arange(size // 2, dtype=torch.float64, device=t.device)
    angles = t.double()[:, None] * 10000 ** (-j / (size // 2 - 1))
    return torch.cat([angles.sin(), angles.cos()], 1).to(dtype)


class ResidualBlock(nn.Module):
    def __init__(self, a: int, b: int, embedding: int):
        super().__init__()
        self.norm1 = gn(a)
        self.conv1 = conv(a, b, 3)
        self.film = nn.Linear(embedding, 2 * b)
        self.norm2 = gn(b)
        self.conv2 = conv(b, b, 3)
        self.skip = conv(a, b, 1) if a != b else nn.Identity()

    def forward(self, x: Tensor, emb: Tensor) -> Tensor:
        """`emb` [B*N, M]: one row per frame."""
        h = self.conv1(F.silu(self.norm1(x)))
        scale, shift = self.film(F.silu(emb))[:, :, None, None].chunk(2, 1)
        h = self.conv2(F.silu(self.norm2(h) * (1 + scale) + shift))
        return self.skip(x) + h


class Attention(nn.Module):
    """One head over the cells of a frame."""

    def __init__(self, channels: int):
        super().__init__()
        self.norm = gn(channels)
        self.qkv = conv(channels, 3 * channels, 1)
        self.project = conv(channels, channels, 1)

    def forward(self, x: Tensor, frames: int) -> Tensor:
        q, k, v = (z.flatten(2).transpose(1, 2) for z in self.qkv(self.norm(x)).chunk(3, 1))
        mixed = F.scaled_dot_product_attention(q, k, v)
        return x + self.project(mixed.transpose(1, 2).reshape(x.shape))


class TemporalAttention(Attention):
    """The same over the frames of a cell; the norm stays frame by frame."""

    def forward(self, x: Tensor, frames: int) -> Tensor:
        # [B*N, C, h, w] to [B, h, w, N, C].
        q, k, v = (bursts(z, frames).permute(0, 3, 4, 1, 2) for z in self.qkv(self.norm(x)).chunk(3, 1))
        mixed = F.scaled_dot_product_attention(q, k, v)
        return x + self.project(mixed.permute(0, 3, 4, 1, 2).flatten(0, 1))


class Level(nn.Module):
    """Residual blocks of one level of one side; attention j follows block j."""

    def __init__(self, sizes: list[tuple[int, int]], embedding: int, attention: bool):
        super().__init__()
        self.blocks = nn.ModuleList(ResidualBlock(a, b, embedding) for a, b in sizes)
        self.attention = nn.ModuleList(Attention(b) for _, b in sizes if attention)

    def step(self, j: int, x: Tensor, emb: Tensor, frames: int) -> Tensor:
        x = self.blocks[j](x, emb)
        return self.attention[j](x, frames) if self.attention else x


class Middle(nn.Module):
    def __init__(self, channels: int, embedding: int, temporal: bool):
        super().__init__()
        self.first = ResidualBlock(channels, channels, embedding)
        self.attention = Attention(channels)
        self.temporal = TemporalAttention(channels) if temporal else None
        self.second = ResidualBlock(channels, channels, embedding)

    def forward(self, x: Tensor, emb: Tensor, frames: int) -> Tensor:
        x = self.attention(self.first(x, emb), frames)
        if self.temporal is not None:
            x = self.temporal(x, frames)
        return self.second(x, emb)


class Preconditioned:
    """Images in numbers of unit variance around the pre-denoised frames `base`, all in [-1, 1], at the times of the noisy ones."""

    def __init__(self, base: Tensor, x_t: Tensor, x0_prev: Tensor, flag: Tensor, error: Tensor, t: Tensor, frames: int):
        bars = torch.as_tensor(alpha_bar())[t.to("cpu").long()].to(base)
        each = lambda x: x.repeat_interleave(frames)[:, None, None, None]
        signal, noise = each(bars.sqrt()), each((1 - bars).sqrt())
        self.x_t, self.given = x_t, x0_prev * each(flag.to(base))
        left = signal * error
        scale = (left**2 + noise**2).sqrt()
        self.base, self.known, self.unknown = base, error * left / scale, error * noise / scale
        self.error = error
        self.residual = (x_t - signal * base) / scale
        self.earlier = ((x0_prev - base) / error).clamp(-5, 5) * each(flag.to(base))
        self.clarity = (left / noise).log().clamp(-4, 4) / 2

    def prediction(self, out: Tensor) -> Tensor:
        return self.base + self.known * self.residual + self.unknown * out


class UNet(nn.Module):
    def __init__(self, config: dict):
        super().__init__()
        unet, self.fold = config["unet"], config["fold"]
        self.size = size = unet["embedding"]
        self.time_in, self.time_out = nn.Linear(size, size), nn.Linear(size, size)
        self.sensor_in, self.sensor_out = nn.Linear(11, size), nn.Linear(size, size)

        widths = [unet["width"] * m for m in unet["multipliers"]]
        levels, blocks = len(widths), unet["blocks"]
        before = [widths[0], *widths[:-1]]
        self.predicts = unet.get("predicts", "edm")
        self.inp = conv((4 if self.predicts == "x0" else 6) * self.fold**2, widths[0], 3)
        self.merge = nn.ModuleList(
            conv(x + fused, x, 1) for x, fused in zip(before, config["fusion"]["widths"])
        )
        self.encoder = nn.ModuleList(
            Level([(a, b)] + [(b, b)] * (blocks - 1), size, k in unet["attention"])
            for k, (a, b) in enumerate(zip(before, widths))
        )
        self.down = nn.ModuleList(conv(c, c, 3, stride=2) for c in widths[:-1])
        self.middle = Middle(widths[-1], size, unet["temporal"])
        self.decoder = nn.ModuleList(
            Level([(2 * c, c)] * blocks, size, k in unet["attention"]) for k, c in enumerate(widths)
        )
        self.up = nn.ModuleList(conv(widths[k], widths[k - 1], 3) for k in range(1, levels))
        self.norm = gn(widths[0])
        self.out = conv(widths[0], self.fold**2, 3)

    def embed(self, t: Tensor, sensor: Tensor) -> Tensor:
        time = self.time_out(F.silu(self.time_in(sinusoids(t, self.size, sensor.dtype))))
        return time + self.sensor_out(F.silu(self.sensor_in(sensor)))

    def forward(
        self, noisy: Preconditioned, guide: Tensor, fused: list[Tensor], t: Tensor, sensor: Tensor, frames: int
    ) -> Tensor:
        emb = self.embed(t, sensor).repeat_interleave(frames, 0)
        clean, _, difference, _, _ = normalized_input(guide)
        images = [noisy.base, noisy.residual, noisy.earlier, 2 * clean - 1, difference, noisy.clarity]
        if self.predicts == "x0":
            images = [noisy.base, noisy.x_t, noisy.given, 2 * clean - 1]
        x = self.inp(F.pixel_unshuffle(torch.cat(images, 1), self.fold))
        skips: list[Tensor] = []
        for k, level in enumerate(self.encoder):
            if k < len(self.merge):
                x = self.merge[k](torch.cat([x, fused[k]], 1))
            for j in range(len(level.blocks)):
                x = level.step(j, x, emb, frames)
                skips.append(x)
            if k < len(self.down):
                x = self.down[k](x)
        x = self.middle(x, emb, frames)
        for k, level in reversed(list(enumerate(self.decoder))):
            for j in range(len(level.blocks)):
                x = level.step(j, torch.cat([x, skips.pop()], 1), emb, frames)
            if k > 0:
                x = self.up[k - 1](F.interpolate(x, scale_factor=2, mode="nearest"))
        out = F.pixel_shuffle(self.out(F.silu(self.norm(x))), self.fold)
        if self.predicts == "correction":
            return noisy.base + noisy.error * out
        return out if self.predicts == "x0" else noisy.prediction(out)


class Qudi(nn.Module):
    def __init__(self, config: dict):
        super().__init__()
        self.noisy = config["features"].get("noisy", "residual")
        self.pre = PreDenoiser(config)
        if config["pre"].get("error"):
            self.error = ErrorHead(config)
        self.low = Low(config)
        self.high = High(config)
        self.flow = Flow(config)
        self.fusion = Fusion(config)
        self.unet = UNet(config)

    def forward(
        self,
        u: Tensor,
        guide: Tensor,
        y_sim: Tensor,
        u_sim: Tensor,
        flag: Tensor,
        x_t: Tensor,
        x0_prev: Tensor,
        t: Tensor,
        sensor: Tensor,
        frames: int,
        flows: Flows | None = None,
    ) -> tuple[Tensor, Tensor, Flows]:
        """x0 in [-1, 1] (not clipped), d in image units, and the flows, new unless given."""
        d, g = self.pre(guide, y_sim, u_sim, flag)
        noisy = Preconditioned(2 * d - 1, x_t, x0_prev, flag, 2 * self.errors(g, guide), t, frames)
        x0, flows = self.correct(noisy, u, u_sim, guide, d, g, t, sensor, frames, flows)
        return x0, d, flows

    def errors(self, g: Tensor, guide: Tensor) -> Tensor:
        """Deviation of the pre-denoised frames' errors, in image units."""
        return self.error(g, guide).detach() if hasattr(self, "error") else 0.3 * normalized_input(guide)[1]

    def correct(
        self,
        noisy: Preconditioned,
        u: Tensor,
        u_sim: Tensor,
        guide: Tensor,
        d: Tensor,
        g: Tensor,
        t: Tensor,
        sensor: Tensor,
        frames: int,
        flows: Flows | None = None,
    ) -> tuple[Tensor, Flows]:
        """What follows the pre-denoiser."""
        low = self.low(u, u_sim, d, frames)
        images = (noisy.x_t, noisy.given) if self.noisy == "image" else (noisy.residual, noisy.earlier)
        high = self.high(*images, frames)
        if flows is None:
            flows = self.flow(d, normalized_input(guide)[0].detach(), mean_variance(sensor, frames), frames)
        fused = self.fusion(low, high, g, flows, frames)
        return self.unet(noisy, guide, fused, t, sensor, frames), flows


# The loss (without the perceptual term)


def fidelity(p: Tensor, q: Tensor, tv: float = 0.01) -> Tensor:
    """Mean square plus tv times (mean |horizontal| + mean |vertical| forward differences of p - q)."""
    e = p - q
    across, down = e[..., 1:] - e[..., :-1], e[..., 1:, :] - e[..., :-1, :]
    return (e**2).mean() + tv * (across.abs().mean() + down.abs().mean())


def loss(x0: Tensor, d: Tensor, truth: Tensor) -> Tensor:
    """On [0, 1]; neither estimate is clipped."""
    return fidelity((x0 + 1) / 2, truth) + 0.2 * fidelity(d, truth)


# The sampling loop


def steps(count: int) -> list[tuple[int, int]]:
    """(t, next t) of every reverse step; next t = -1 is the finished image."""
    times = [int(t) for t in np.linspace(-1, 999, count + 1)[::-1]]
    return list(zip(times, times[1:]))


def coefficients(t: int, after: int, ancestral: bool) -> tuple[float, float, float]:
    """The step is x <- c0 x0 + cx x + sigma noise; ancestral draws from q(x_after | x_t, x0)."""
    bars = alpha_bar()
    a, b = bars[t], bars[after] if after >= 0 else 1.0
    if not ancestral:
        cx = math.sqrt(1 - b) / math.sqrt(1 - a)
        return math.sqrt(b) - cx * math.sqrt(a), cx, 0.0
    alpha = a / b
    sigma = math.sqrt((1 - b) / (1 - a) * (1 - alpha))
    return math.sqrt(b) * (1 - alpha) / (1 - a), math.sqrt(alpha) * (1 - b) / (1 - a), sigma


# crates/qudi-core/sensors/qudi-paper.toml: 3-bit counts.
QE, DARK, READ, FULL_WELL, FULL_SCALE = 0.8, 1.6, 0.2, 200, 7


def gain(ppp: float) -> float:
    return 0.5 * FULL_SCALE / ppp


def light(ppp: float, t: int) -> float:
    """PPP of the simulated measurement at time t."""
    return ppp * 10 ** (1 - t / 1000)


def expose(rng: np.random.Generator, image: np.ndarray, ppp: float, exposure: float) -> np.ndarray:
    """Counts of an image in [0, 1]. The gain rule makes the gain follow the light."""
    electrons = np.minimum(rng.poisson(QE * image.astype(np.float64) * ppp / exposure + DARK), FULL_WELL)
    volts = electrons + rng.normal(0, READ, image.shape)
    return np.clip(np.rint(gain(ppp) * volts), 0, FULL_SCALE).astype(np.uint8)


def linear(ppp: float, exposure: float) -> np.ndarray:
    """Linear estimate of every count 0..7, in image units."""
    counts = np.arange(FULL_SCALE + 1)
    return np.clip((counts / gain(ppp) - DARK) / QE * exposure / ppp, 0, 2).astype(np.float32)


def deviation(ppp: float, exposure: float, image: float) -> float:
    """Of the linear estimate, summed over electrons and the reading's steps."""
    electrons = np.arange(FULL_WELL + 1)
    rate = QE * image * ppp / exposure + DARK
    weight = np.exp(electrons * math.log(rate) - rate - np.array([math.lgamma(k + 1) for k in electrons]))
    weight[-1] += 1 - weight.sum()
    edges = (np.arange(FULL_SCALE) + 0.5) / gain(ppp)
    below = np.array([[0.5 * math.erfc((k - edge) / READ / math.sqrt(2)) for edge in edges] for k in electrons])
    chances = weight @ np.diff(below, prepend=0, append=1)
    values = linear(ppp, exposure).astype(np.float64)
    mean = chances @ values
    return math.sqrt(chances @ (values - mean) ** 2)


def sensor_numbers(ppp: float, exposure: float) -> list[float]:
    numbers = [math.log10(ppp), exposure, QE, DARK, READ, math.log10(gain(ppp)), math.log2(FULL_SCALE + 1) / 8, 0.0, 0.0]
    return numbers + [math.log10(deviation(ppp, exposure, image)) for image in (0, exposure)]


def sample(
    model: Qudi,
    u: Tensor,
    guide: Tensor,
    sensor: Tensor,
    frames: int,
    flow_steps: list[int],
    noise: Callable[[int], Tensor],
    measure: Callable[[int, int, Tensor], tuple[Tensor, Tensor]],
    count: int = 10,
    ancestral: bool = False,
) -> Iterator[tuple[Tensor, Tensor]]:
    """x and the clipped x0 after every step.

    `noise(0)` is x_T and `noise(k)` that of step k, the first being 1; `measure(k, t, x0)` gives
    y_sim and u_sim for step k from the estimate of step k - 1.
    """
    x, flows = noise(0), None
    estimate = y_sim = u_sim = torch.zeros_like(x)
    for k, (t, after) in enumerate(steps(count), 1):
        if k > 1:
            y_sim, u_sim = measure(k, t, estimate)
        flag = torch.full((len(sensor),), float(k > 1), dtype=x.dtype)
        time = torch.full((len(sensor),), t)
        known = None if k in flow_steps else flows
        x0, _, flows = model(u, guide, y_sim, u_sim, flag, x, estimate, time, sensor, frames, known)
        estimate = x0.clamp(-1, 1)
        c0, cx, sigma = coefficients(t, after, ancestral)
        x = c0 * estimate + cx * x
        if sigma > 0:
            x = x + sigma * noise(k)
        yield x, estimate


def main() -> None:
    if len(sys.argv) != 3 or sys.argv[1] != "info":
        sys.exit("usage: network.py info PRESET")
    config = load(sys.argv[2])
    model = Qudi(config)
    for name, block in [*model.named_children(), ("all", model)]:
        print(f"{name:8}{sum(p.numel() for p in block.parameters()):12,}")
    print(f"frame sizes are multiples of {multiple(config)}")


if __name__ == "__main__":
    main()
