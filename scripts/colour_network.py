# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "safetensors", "torch"]
# ///
"""Trains the network that corrects colours behind a filter, on evidence that an example of qudi-model writes.

    cargo run --release --example colour_evidence -- PICTURES EVIDENCE
    python scripts/colour_network.py EVIDENCE OUTPUT.safetensors [--minutes 30] [--seed 0]

EVIDENCE holds, for every picture, `NAME-evidence.npy` (frames, 15, height, width), `NAME-truth.npy` (frames, 3,
height, width) in linear light and `NAME-weights.npy` (3,), the weights of red, green and blue in luma. The
planes of evidence and the layers are the ones of crates/qudi-model/src/colour.

The loss of an image is the logarithm of its squared error in linear light and of its distance in CIELAB, both
in units of the errors without the network, after one common gain. The program makes less of a correction of
ratios where colours are even; training does not, which gave 0.03 to 0.07 dB more (one seed each).
"""

import argparse
import math
import pathlib
import time

import numpy as np
import torch
import torch.nn.functional as F
from safetensors.torch import save_file
from torch import nn

PLANES = 15
WIDTHS = (32, 64, 64)
HANDED_UP = 32

# How far an output of 1 moves a ratio, and a logarithm of luma.
RATIO_STEP = 0.3
LUMA_STEP = 0.1

CROP = 96
BATCH = 8

SRGB_TO_XYZ = torch.tensor(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)


class Block(nn.Module):
    """Two convolutions around a ReLU, added to their input."""

    def __init__(self, width):
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)

    def forward(self, x):
        return x + self.second(F.relu(self.first(x)))


class Stack(nn.Module):
    """A convolution with ReLU, then a residual block."""

    def __init__(self, inputs, width):
        super().__init__()
        self.entry = nn.Conv2d(inputs, width, 3, padding=1)
        self.blocks = nn.ModuleList([Block(width)])

    def forward(self, *x):
        return self.blocks[0](F.relu(self.entry(torch.cat(x, 1))))


class Hourglass(nn.Module):
    """Residual stacks from fine to coarse and back, with skips."""

    def __init__(self, inputs):
        super().__init__()
        a, b, c = WIDTHS
        self.encoder = nn.ModuleList([Stack(inputs, a), Stack(a, b), Stack(b, c)])
        self.up = nn.ModuleList([nn.Conv2d(b, 4 * HANDED_UP, 1), nn.Conv2d(c, 4 * HANDED_UP, 1)])
        self.decoder = nn.ModuleList([Stack(a + HANDED_UP, a), Stack(b + HANDED_UP, b)])

    def forward(self, x):
        fine = self.encoder[0](x)
        middle = self.encoder[1](F.avg_pool2d(fine, 2))
        coarse = self.encoder[2](F.avg_pool2d(middle, 2))
        middle = self.decoder[1](middle, F.pixel_shuffle(self.up[1](coarse), 2))
        return self.decoder[0](fine, F.pixel_shuffle(self.up[0](middle), 2))


class ColourNetwork(nn.Module):
    """Corrections of luma and of the three ratios, from the planes of evidence."""

    def __init__(self):
        super().__init__()
        self.hourglass = Hourglass(4 * PLANES)
        self.out = nn.Conv2d(WIDTHS[0] // 4, 4, 3, padding=1)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, features):
        """Returns (images, 4, height, width) from (images, 15, height, width)."""
        x = self.hourglass(F.pixel_unshuffle(features, 2))
        return self.out(F.pixel_shuffle(x, 2))


def features(evidence):
    """Scales the planes of evidence to inputs of about unit size."""
    luma, ratios, scores, precisions, sigmas, luma_score, luma_precision = torch.split(
        evidence, [1, 3, 3, 3, 3, 1, 1], 1
    )
    return torch.cat(
        [
            0.7 * torch.log(torch.clamp(luma + 0.02, min=1e-4)),
            torch.clamp(ratios - 1, max=4),
            torch.clamp(0.5 * scores, -2.5, 2.5),
            torch.clamp(0.3 * precisions, max=4),
            torch.clamp(3 * sigmas, max=3),
            torch.clamp(0.5 * luma_score, -2.5, 2.5),
            torch.clamp(0.1 * luma_precision, max=4),
        ],
        1,
    )


def colours(evidence, weights, output):
    """Returns corrected colours, in units of the mean of luma."""
    weights = weights[:, :, None, None]
    ratios = torch.clamp(evidence[:, 1:4] + RATIO_STEP * output[:, :3], 0, 12)
    ratios = ratios / torch.clamp((ratios * weights).sum(1, keepdim=True), min=1e-3)
    luma = evidence[:, :1] * torch.exp(torch.clamp(LUMA_STEP * output[:, 3:], -1, 1))
    return luma * ratios


def lab(colour):
    """Converts linear sRGB to CIELAB."""
    white = SRGB_TO_XYZ.sum(1)
    xyz = torch.einsum("ij,bjhw->bihw", SRGB_TO_XYZ / white[:, None], torch.clamp(colour, 0, 1))
    knee = 6 / 29
    root = torch.clamp(xyz, min=1e-6) ** (1 / 3)
    f = torch.where(xyz > knee**3, root, xyz / (3 * knee**2) + 4 / 29)
    return torch.stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], 1)


def best_gain(colour, truth):
    """Returns the common gain that fits images to the truth best."""
    products = (colour * truth).flatten(1).sum(1) / (colour * colour).flatten(1).sum(1)
    return products[:, None, None, None]


def loss(restored, before, truth):
    """Mean logarithm of the errors, in units of the ones `before`."""

    def squared(colour):
        return ((torch.clamp(colour, 0, 1) - truth) ** 2).mean((1, 2, 3)) + 1e-5

    target = lab(truth)

    def distance(colour):
        return ((lab(colour) - target).square().sum(1) + 1).sqrt().mean((1, 2)) - 0.9

    linear = torch.log(squared(restored) / squared(before)).mean()
    return 0.5 * linear + torch.log(distance(restored) / distance(before)).mean()


def load(folder):
    """Reads evidence, truth and weights of all frames."""
    parts = [[], [], []]
    for path in sorted(folder.glob("*-evidence.npy")):
        evidence, truth, weights = (
            np.load(path.with_name(path.name.replace("evidence", kind))) for kind in ("evidence", "truth", "weights")
        )
        parts[0].append(evidence.astype(np.float32))
        parts[1].append(truth.astype(np.float32))
        parts[2].append(np.repeat(weights[None].astype(np.float32), len(evidence), 0))
    return [torch.tensor(np.concatenate(part)) for part in parts]


def batch(data, gains, generator):
    """Draws crops, turned and mirrored."""

    def below(limit):
        return int(torch.randint(limit, (), generator=generator))

    evidence, truth, weights = data
    chosen = torch.randint(len(evidence), (BATCH,), generator=generator)
    _, _, height, width = evidence.shape
    top, left = 2 * below((height - CROP) // 2 + 1), 2 * below((width - CROP) // 2 + 1)
    axes = [axis for axis in (2, 3) if below(2)]
    turned = below(2)

    def cut(images):
        part = images[chosen][:, :, top : top + CROP, left : left + CROP].flip(axes)
        return part.transpose(2, 3) if turned else part

    return cut(evidence), cut(truth), weights[chosen], gains[chosen]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("evidence", type=pathlib.Path)
    parser.add_argument("output", type=pathlib.Path)
    parser.add_argument("--minutes", type=float, default=30)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    torch.manual_seed(arguments.seed)
    torch.set_num_threads(arguments.threads)
    generator = torch.Generator().manual_seed(arguments.seed)
    data = load(arguments.evidence)
    unchanged = torch.zeros(1, 4, 1, 1)
    gains = torch.cat(
        [best_gain(colours(e[None], w[None], unchanged), t[None]) for e, t, w in zip(*data, strict=True)]
    )
    network, average = ColourNetwork(), ColourNetwork()
    average.load_state_dict(network.state_dict())
    print(f"{len(data[0])} frames, {sum(p.numel() for p in network.parameters())} parameters", flush=True)
    optimizer = torch.optim.AdamW(network.parameters(), lr=2e-3, weight_decay=1e-3)
    start, step, losses = time.time(), 0, []
    while (done := (time.time() - start) / (60 * arguments.minutes)) < 1:
        for group in optimizer.param_groups:
            group["lr"] = 2e-3 * min(1, (step + 1) / 100) * (0.5 + 0.5 * math.cos(math.pi * done)) + 1e-5
        evidence, truth, weights, gain = batch(data, gains, generator)
        with torch.autocast("cpu", torch.bfloat16):
            output = network(features(evidence))
        restored = gain * colours(evidence, weights, output.float())
        before = gain * colours(evidence, weights, unchanged)
        error = loss(restored, before, truth)
        optimizer.zero_grad()
        error.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        with torch.no_grad():
            for kept, new in zip(average.parameters(), network.parameters(), strict=True):
                kept.lerp_(new, 0.003)
        step += 1
        losses.append(float(error.detach()))
        if step % 500 == 0:
            print(f"step {step}, {60 * done * arguments.minutes:.0f} s: loss {np.mean(losses):.4f}", flush=True)
            losses = []
            save(average, arguments, step)
    save(average, arguments, step)


def save(network, arguments, step):
    """Writes the weights in half precision."""
    weights = {name: value.half().contiguous() for name, value in network.state_dict().items()}
    metadata = {"steps": str(step), "batch": str(BATCH), "seed": str(arguments.seed)}
    save_file(weights, arguments.output, metadata)


if __name__ == "__main__":
    main()
