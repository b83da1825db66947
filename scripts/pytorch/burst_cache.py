"""Reads the cached bursts of `qudi train --bursts` (crates/qudi-train/src/burst_cache.rs), and models their sensors."""

import json
import math
import struct
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

TYPES = {"F32": np.dtype("<f4"), "U16": np.dtype("<u2"), "I8": np.dtype("i1")}
STEPS = 32.0  # of a byte
HELD = 13  # one burst of so many is not learnt from


class Sensor:
    """A sensor and its light, `factor` times as much as in the capture (crates/qudi-core/src/sensor/law.rs)."""

    def __init__(self, label: dict, factor: float = 1.0) -> None:
        about, self.ppp, self.exposure = label["sensor"], label["ppp"], label["exposure"]
        self.binary, self.frames = about["response"] == "binary", about["frames_summed"]
        self.efficiency, self.read_noise = about["quantum_efficiency"], about["read_noise"]
        dark = about["dark"]
        dark = float(dark.removesuffix("/s")) / about["fps"] if isinstance(dark, str) else dark
        if self.binary:
            before, self.frames = self.frames, max(1, round(self.frames * factor))
            self.ppp *= self.frames / before
            self.gain, self.full_well, self.full_scale = label["gain"], 1, self.frames
        else:
            self.ppp *= factor
            self.gain, self.full_well = label["gain"] / factor, round(about["full_well"] * factor)
            self.full_scale = 2 ** about["bits"] - 1
        self.dark = dark * self.frames
        counts = np.arange(self.full_scale + 1.0)
        if self.binary:
            detections = -self.frames * np.log1p(-np.minimum(counts, max(self.frames - 1, 0.5)) / self.frames)
        else:
            detections = counts / self.gain
        photons = np.maximum(detections - self.dark, 0) / self.efficiency
        self.linear = np.minimum(photons * self.exposure / self.ppp, 2).astype(np.float32)

    def rate(self, image: np.ndarray | float) -> np.ndarray:
        """Detections expected per output frame."""
        return self.efficiency * np.asarray(image, np.float64) * self.ppp / self.exposure + self.dark

    def deviation(self, image: float) -> float:
        """Of the linear estimate, by the count's exact law."""
        rate = max(float(self.rate(image)), 1e-12)
        if self.binary:
            hit = -math.expm1(-rate / self.frames)
            count = range(self.frames + 1)
            chances = np.array([math.comb(self.frames, k) * hit**k * (1 - hit) ** (self.frames - k) for k in count])
        else:
            electrons = range(self.full_well + 1)
            weight = np.array([math.exp(k * math.log(rate) - rate - math.lgamma(k + 1)) for k in electrons])
            weight[-1] += 1 - weight.sum()
            edges = (np.arange(self.full_scale) + 0.5) / self.gain
            spread = self.read_noise * math.sqrt(2)
            below = np.array([[0.5 * math.erfc((k - edge) / spread) for edge in edges] for k in electrons])
            chances = weight @ np.diff(below, prepend=0, append=1)
        values = self.linear.astype(np.float64)
        return math.sqrt(max(chances @ (values - chances @ values) ** 2, 0))

    def numbers(self) -> list[float]:
        """The numbers of the sensor that the network is given (docs/network.md, "Inputs")."""
        deviations = [math.log10(max(self.deviation(image), 1e-4)) for image in (0.0, self.exposure)]
        light = [math.log10(max(self.ppp, 1e-6)), self.exposure, self.efficiency, self.dark, self.read_noise]
        depth = [math.log10(max(self.gain, 1e-6)), math.log2(self.full_scale + 1) / 8]
        return light + depth + [float(self.binary), math.log2(self.frames) / 8] + deviations

    def measure(self, image: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Counts over full scale and linear estimates of images in [0, 1]."""
        rate = self.rate(image)
        if self.binary:
            counts = rng.binomial(self.frames, -np.expm1(-rate / self.frames))
        else:
            electrons = np.minimum(rng.poisson(rate), self.full_well) + rng.normal(0, self.read_noise, rate.shape)
            counts = np.clip(np.rint(self.gain * electrons), 0, self.full_scale).astype(np.int64)
        return (counts / self.full_scale).astype(np.float32), self.linear[counts]


@dataclass
class Part:
    """Squares of frames of a burst: inputs [frames, planes, side, side], truth and linear estimate [frames, 1, side, side]."""

    guide: np.ndarray
    truth: np.ndarray
    u: np.ndarray


class Burst:
    """A cached burst, read where it is needed."""

    def __init__(self, path: Path) -> None:
        with path.open("rb") as file:
            (length,) = struct.unpack("<Q", file.read(8))
            header = json.loads(file.read(length))
        raw = np.memmap(path, np.uint8, "r")

        def plane(name: str) -> np.ndarray:
            about = header[name]
            first, last = (8 + length + offset for offset in about["data_offsets"])
            kind = TYPES[about["dtype"]]
            return np.frombuffer(raw, kind, (last - first) // kind.itemsize, first).reshape(about["shape"])

        def planes(kind: str) -> list[np.ndarray]:
            return [plane(f"{kind}.{k}") for k in range(sum(name.startswith(f"{kind}.") for name in header))]

        self.label = tomllib.loads(header["__metadata__"]["burst"])
        self.truth, self.counts = plane("truth"), plane("counts")
        self.images, self.deviations = planes("image"), planes("deviation")
        self.sensor = Sensor(self.label)
        self.numbers = self.sensor.numbers()

    def square(self, top: int, left: int, side: int, frames: slice = slice(None)) -> Part:
        place = (frames, slice(top, top + side), slice(left, left + side))
        images = np.stack([plane[place] for plane in self.images], 1)
        deviations = np.stack([plane[place] for plane in self.deviations], 1).astype(np.float32)
        guide = np.concatenate([images, 0.5 * np.sinh(deviations / STEPS)], 1)
        return Part(guide, self.truth[place][:, None], self.sensor.linear[self.counts[place]][:, None])

    def part(self, side: int, rng: np.random.Generator, frames: slice = slice(None)) -> Part:
        """Some square, turned and mirrored somehow."""
        height, width = self.truth.shape[1:]
        part = self.square(rng.integers(height - side + 1), rng.integers(width - side + 1), side, frames)
        flipped, mirrored, turned = rng.random(3) < 0.5
        for name, planes in vars(part).items():
            planes = planes[..., ::-1, :] if flipped else planes
            planes = planes[..., ::-1] if mirrored else planes
            setattr(part, name, np.ascontiguousarray(planes.swapaxes(-1, -2) if turned else planes))
        return part

    def frame(self, side: int, rng: np.random.Generator) -> Part:
        """The same of some single frame."""
        first = rng.integers(len(self.truth))
        return self.part(side, rng, slice(first, first + 1))


def cached_bursts(folder: Path) -> tuple[list[Burst], list[Burst]]:
    """The bursts of a folder to learn from, and those held back, which more bursts do not change."""
    paths = sorted(folder.glob("*.safetensors"))
    held = [int(path.stem.rpartition("-")[2]) % HELD == 0 for path in paths]
    if all(held) or not any(held):
        raise SystemExit(f"{folder}: {len(paths)} bursts, {sum(held)} to be held back (number a multiple of {HELD}): draw more")
    return [Burst(p) for p, h in zip(paths, held) if not h], [Burst(p) for p, h in zip(paths, held) if h]
