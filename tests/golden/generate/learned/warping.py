# /// script
# requires-python = ">=3.11"
# dependencies = ["torch"]
# ///
"""Operations that references of several published networks share: sampling, deformable convolution, flow.

Flows are [N, 2, H, W] (x, y), in pixels of their own grid.
"""

from collections.abc import Iterable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

# Operations


def conv(a: int, b: int, kernel: int, stride: int = 1, bias: bool = True) -> nn.Conv2d:
    return nn.Conv2d(a, b, kernel, stride, kernel // 2, bias=bias)


def conv_transpose(a: int, b: int) -> nn.ConvTranspose2d:
    """Doubles the size."""
    return nn.ConvTranspose2d(a, b, 3, 2, 1, output_padding=1)


def bilinear(x: Tensor, columns: Tensor, rows: Tensor, padding: str = "zeros") -> Tensor:
    """x [N, C, H, W] at coordinates [N, h, w] in pixels (0: the centre of the first)."""
    height, width = x.shape[2:]
    # With corners at the outer edges of pixels: the same points, and defined where a side is one pixel.
    grid = torch.stack([(2 * columns + 1) / width - 1, (2 * rows + 1) / height - 1], dim=3)
    return F.grid_sample(x, grid, mode="bilinear", padding_mode=padding, align_corners=False)


def cells(x: Tensor) -> tuple[Tensor, Tensor]:
    """Columns [W] and rows [H, 1] of an image."""
    height, width = x.shape[-2:]
    return torch.arange(width).to(x), torch.arange(height).to(x)[:, None]


def warp(x: Tensor, flow: Tensor, padding: str = "zeros") -> Tensor:
    """x at (column + flow_x, row + flow_y)."""
    columns, rows = cells(x)
    return bilinear(x, columns + flow[:, 0], rows + flow[:, 1], padding)


def resize(x: Tensor, height: int, width: int) -> Tensor:
    """Bilinear, corners at the outer edges of pixels, no filter before it."""
    return F.interpolate(x, (height, width), mode="bilinear", align_corners=False)


def reduce(x: Tensor, factor: int) -> Tensor:
    """By 2: means of 2x2 pixels; by 4: means of the middle 2x2 of 4x4 pixels."""
    return resize(x, x.shape[2] // factor, x.shape[3] // factor)


def up2_corner(x: Tensor) -> Tensor:
    """Twice the size, bilinear, corners at the centres of pixels."""
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=True)


def deform_samples(x: Tensor, offset: Tensor, groups: int, kernel: int = 3) -> Tensor:
    """What the taps of a deformable convolution see: [N, groups, C / groups, taps, H, W].

    Channels of `offset` are (group, tap, (dy, dx)); outside the image x is zero.
    """
    n, channels, height, width = x.shape
    taps = kernel**2
    offset = offset.view(n * groups, taps, 2, height, width)
    tap = torch.arange(taps).to(x)
    columns, rows = cells(x)
    columns = columns + offset[:, :, 1] + (tap % kernel - kernel // 2)[:, None, None]
    rows = rows + offset[:, :, 0] + (tap // kernel - kernel // 2)[:, None, None]
    # The taps one below the other.
    y = bilinear(x.reshape(n * groups, -1, height, width), columns.flatten(1, 2), rows.flatten(1, 2))
    return y.view(n, groups, channels // groups, taps, height, width)


def deform_conv(x: Tensor, offset: Tensor, mask: Tensor, weight: Tensor, bias: Tensor, groups: int) -> Tensor:
    """Modulated deformable convolution of stride 1; channels of `mask` are (group, tap)."""
    n, _, height, width = x.shape
    samples = deform_samples(x, offset, groups, weight.shape[2])
    samples = samples * mask.view(n, groups, 1, -1, height, width)
    y = weight.flatten(1) @ samples.reshape(n, -1, height * width)
    return y.view(n, -1, height, width) + bias[:, None, None]


# Flow


class FlowLevel(nn.Module):
    def __init__(self, channels: int, widths: tuple[int, ...]):
        super().__init__()
        sizes = [channels, *widths, 2]
        layers: list[nn.Module] = []
        for a, b in zip(sizes, sizes[1:]):
            layers += [conv(a, b, 7), nn.ReLU()]
        self.basic_module = nn.Sequential(*layers[:-1])

    def forward(self, x: Tensor) -> Tensor:
        return self.basic_module(x)


class SpyNet(nn.Module):
    """Flow in a pyramid: "Optical Flow Estimation using a Spatial Pyramid Network", Ranjan, Black, CVPR 2017."""

    def __init__(
        self,
        mean: tuple[float, ...] = (0.449,),
        std: tuple[float, ...] = (0.226,),
        levels: int = 4,
        widths: tuple[int, ...] = (32, 64, 32, 16),
        multiple: int = 32,
    ):
        super().__init__()
        self.multiple = multiple
        self.register_buffer("mean", torch.tensor(mean).view(1, -1, 1, 1))
        self.register_buffer("std", torch.tensor(std).view(1, -1, 1, 1))
        self.basic_module = nn.ModuleList(FlowLevel(2 * len(mean) + 2, widths) for _ in range(levels))

    def pyramid(self, x: Tensor) -> list[Tensor]:
        """Coarsest first."""
        # Images of one channel are broadcast to as many as there are means.
        images = [(x - self.mean) / self.std]
        for _ in self.basic_module[1:]:
            images.append(F.avg_pool2d(images[-1], 2))
        return images[::-1]

    def forward(self, ref: Tensor, supp: Tensor, scales: Iterable[int] = (1, 2, 4)) -> list[Tensor]:
        """From pixels of `ref` to their places in `supp`, at the size of the images over each of `scales`."""
        height, width = ref.shape[2:]
        padded = [-(-size // self.multiple) * self.multiple for size in (height, width)]
        pyramids = [self.pyramid(resize(image, *padded)) for image in (ref, supp)]
        flows: list[Tensor] = []
        for module, a, b in zip(self.basic_module, *pyramids):
            up = 2 * up2_corner(flows[-1]) if flows else torch.zeros_like(a[:, :2]).expand(-1, 2, -1, -1)
            flows.append(module(torch.cat([a, warp(b, up, "border"), up], 1)) + up)
        results = []
        for k, scale in enumerate(scales):
            h, w = height // scale, width // scale
            factors = torch.tensor([w / (padded[1] // scale), h / (padded[0] // scale)]).to(ref)
            results.append(resize(flows[-1 - k], h, w) * factors[:, None, None])
        return results
