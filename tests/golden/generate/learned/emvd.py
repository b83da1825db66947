# /// script
# requires-python = ">=3.11"
# dependencies = ["torch"]
# ///
"""EMVD in PyTorch, for golden values.

Maggioni, Huang, Li, Xiao, Fu, Song: Efficient Multi-Stage Video Denoising with Recurrent Spatio-Temporal Fusion,
CVPR 2021; in the size and with the noise model with which it was retrained as a baseline of quanta video restoration.

Frames have four channels, here four copies of a gray image, and sides that are multiples of 8. Every step joins the
previous fused frame (the current one in the first step) and the current one, in a colour space and in wavelet
bands of three levels, and is trained through all steps. Keys of `state_dict()` are those of the published weights.

The four bands of a wavelet transform are sorted by filter of the rows, then of the columns; band b of channel c is
channel 4 b + c.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

CHANNELS = 4
# The standard deviation of the noise is taken from these, at any light: a 12-bit sensor's, not ours.
SLOPE, OFFSET = 1 / 3855, 1 / 3855**2
ROOT = 2**-0.5
COLOUR = (
    (0.5, 0.5, 0.5, 0.5),
    (-0.5, 0.5, 0.5, -0.5),
    (0.65, 0.2784, -0.2784, -0.65),
    (-0.2784, 0.65, -0.65, 0.2764),  # 0.2764 is as published
)


class Step(NamedTuple):
    """What a step gives: `gamma` and `omega` [B, 1, H/2, W/2] are weights, the others images [B, 4, H, W]."""

    gamma: Tensor
    fusion: Tensor
    denoise: Tensor
    omega: Tensor
    refine: Tensor


class Colour(nn.Module):
    """A linear map of the four channels."""

    def __init__(self, rows: Tensor) -> None:
        super().__init__()
        self.net1 = nn.Conv2d(CHANNELS, CHANNELS, 1, bias=False)
        self.net1.weight.data = rows[:, :, None, None].clone()

    def forward(self, x: Tensor) -> Tensor:
        return self.net1(x)


class Wavelet(nn.Module):
    """Two filters along rows, then the same along columns: [B, C, h, w] to [B, 4 C, h/2, w/2]."""

    def __init__(self) -> None:
        super().__init__()
        self.net1 = nn.Conv2d(1, 2, (1, 2), (1, 2), bias=False)
        self.net1.weight.data = torch.tensor([[ROOT, ROOT], [ROOT, -ROOT]]).view(2, 1, 1, 2)

    def forward(self, x: Tensor) -> Tensor:
        b, c, h, w = x.shape
        rows = self.net1(x.reshape(b * c, 1, h, w)).reshape(b * c * 2, 1, h, w // 2)
        bands = F.conv2d(rows, self.net1.weight.transpose(2, 3), stride=(2, 1))
        bands = bands.view(b, c, 4, h // 2, w // 2)
        return bands.transpose(1, 2).reshape(b, 4 * c, h // 2, w // 2)


class Inverse(nn.Module):
    """Columns, then rows: [B, 4 C, h, w] to [B, C, 2 h, 2 w]."""

    def __init__(self) -> None:
        super().__init__()
        self.net1 = nn.ConvTranspose2d(1, 1, (2, 1), (2, 1), bias=False)
        self.net2 = nn.ConvTranspose2d(1, 1, (2, 1), (2, 1), bias=False)
        self.net1.weight.data = torch.tensor([ROOT, ROOT]).view(1, 1, 2, 1)
        self.net2.weight.data = torch.tensor([ROOT, -ROOT]).view(1, 1, 2, 1)

    def forward(self, x: Tensor) -> Tensor:
        b, c, h, w = x.shape
        bands = [band.reshape(b * c // 4, 1, h, w) for band in x.chunk(4, 1)]
        low = self.net1(bands[0]) + self.net2(bands[1])
        high = self.net1(bands[2]) + self.net2(bands[3])
        first, second = (net.weight.transpose(2, 3) for net in (self.net1, self.net2))
        image = F.conv_transpose2d(low, first, stride=(1, 2)) + F.conv_transpose2d(high, second, stride=(1, 2))
        return image.view(b, c // 4, 2 * h, 2 * w)


class Head(nn.Module):
    """Three convolutions; the weights between 0 and 1 end in a sigmoid."""

    def __init__(self, inputs: int, width: int, outputs: int, sigmoid: bool) -> None:
        super().__init__()
        self.net1 = nn.Conv2d(inputs, width, 3, padding=1)
        self.net2 = nn.Conv2d(width, width, 3, padding=1)
        self.net3 = nn.Conv2d(width, outputs, 3, padding=1)
        self.sigmoid = sigmoid

    def forward(self, *x: Tensor) -> Tensor:
        y = self.net3(F.relu(self.net2(F.relu(self.net1(torch.cat(x, 1))))))
        return torch.sigmoid(y) if self.sigmoid else y


class Level(nn.Module):
    """Fuses the bands of the previous and the current frame and denoises them."""

    def __init__(self, width: int, coarsest: bool) -> None:
        super().__init__()
        c = CHANNELS
        # Below the coarsest level, its weights and its denoised image are inputs.
        self.fusion = Head(c + 1 if coarsest else c + 2, width, 1, True)
        self.denoise = Head(5 * c + 1 if coarsest else 6 * c + 1, width, 4 * c, False)

    def forward(self, previous: Tensor, current: Tensor, *coarser: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Weights, fused bands, their noise and denoised bands; `coarser`: weights and denoised image, if any."""
        below, image = ([F.interpolate(coarser[0], scale_factor=2)], [coarser[1]]) if coarser else ([], [])
        low0, low1 = previous[:, :CHANNELS], current[:, :CHANNELS]
        noise0, noise1 = (low[:, :1].clamp(0, 1) * SLOPE + OFFSET for low in (low0, low1))
        gamma = self.fusion((low1 - low0).abs(), *below, noise1)
        fused = previous * (1 - gamma) + current * gamma
        sigma = (1 - gamma) ** 2 * noise0 + gamma**2 * noise1
        return gamma, fused, sigma, self.denoise(fused, *image, low1, sigma)


class Emvd(nn.Module):
    """The published network has a width of 16."""

    def __init__(self, width: int = 16) -> None:
        super().__init__()
        colour = torch.tensor(COLOUR)
        self.ct, self.cti = Colour(colour), Colour(colour.T)
        self.ft, self.fti = Wavelet(), Inverse()
        self.vd, self.md1, self.md0 = Level(width, True), Level(width, False), Level(width, False)
        self.refine = Head(8 * CHANNELS + 1, width, 1, True)

    def bands(self, x: Tensor) -> list[Tensor]:
        """Of three levels, the finest first."""
        levels = [self.ft(self.ct(x))]
        for _ in range(2):
            levels.append(self.ft(levels[-1][:, :CHANNELS]))
        return levels

    def step(self, previous: Tensor, current: Tensor) -> Step:
        before, now = self.bands(previous), self.bands(current)
        gamma, fused, sigma, denoised = self.vd(before[2], now[2])
        for k, level in ((1, self.md1), (0, self.md0)):
            gamma, fused, sigma, denoised = level(before[k], now[k], gamma, self.fti(denoised))
        omega = self.refine(fused, denoised, sigma)
        refined = denoised * (1 - omega) + fused * omega
        image = lambda bands: self.cti(self.fti(bands))
        return Step(gamma, image(fused), image(denoised), omega, image(refined))

    def forward(self, x: Tensor) -> list[Step]:
        """Frames [B, T, 4, H, W]; the restored frames are `refine`."""
        steps: list[Step] = []
        for current in x.unbind(1):
            steps.append(self.step(steps[-1].fusion if steps else current, current))
        return steps


def orthogonality(net: Emvd) -> Tensor:
    """How far the transforms are from inverses: squared entries of two products less the identity, added.

    Rows of the matrices are the outputs of `ct`, `cti` and `ft`, and `fti.net1` and `fti.net2`.
    """
    matrix = lambda module: module.net1.weight.flatten(1)
    inverse = torch.cat([net.fti.net1.weight.flatten(1), net.fti.net2.weight.flatten(1)])
    total = torch.zeros_like(inverse[0, 0])
    for a, b in ((matrix(net.ct), matrix(net.cti)), (matrix(net.ft), inverse)):
        total = total + (a @ b - torch.eye(len(a), dtype=a.dtype)).square().sum()
    return total


def loss(net: Emvd, steps: list[Step], truth: Tensor) -> Tensor:
    """Mean absolute error of `refine`, of all steps and all four channels, and `orthogonality`."""
    refined = torch.stack([step.refine for step in steps], 1)
    return F.l1_loss(refined, truth) + orthogonality(net)
