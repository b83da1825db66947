# /// script
# requires-python = ">=3.11"
# dependencies = ["torch"]
# ///
"""FloRNN in PyTorch, written from a description, with the PWC-Net that it takes flow from.

"Unidirectional Video Denoising by Mimicking Backward Recurrent Modules with Look-ahead Forward Ones", J. Li, X. Wu,
Z. Niu, W. Zuo, ECCV 2022. "PWC-Net: CNNs for Optical Flow Using Pyramid, Warping, and Cost Volume", D. Sun, X. Yang,
M.-Y. Liu, J. Kautz, CVPR 2018. "Softmax Splatting for Video Frame Interpolation", S. Niklaus, F. Liu, CVPR 2020.

Keys of `state_dict()` are those of the authors' weight files. Images are [B, T, C, H, W] in [0, 1]. Sides are at
least 1 / `border_ratio` pixels, and frames more than `forward_count`.

    python tests/golden/generate/learned/flornn.py    counts the parameters
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from warping import cells, conv, resize, warp

# Operations


def correlation(first: Tensor, second: Tensor, radius: int = 4) -> Tensor:
    """Means over channels of first(p) * second(p + (dx, dy)), zeros outside: channel (dy, dx), dx faster."""
    height, width = first.shape[2:]
    side = 2 * radius + 1
    padded = F.pad(second, (radius,) * 4)
    shifted = [padded[:, :, y : y + height, x : x + width] for y in range(side) for x in range(side)]
    return torch.stack([(first * image).mean(1) for image in shifted], 1)


def splat_average(x: Tensor, flow: Tensor) -> Tensor:
    """Every pixel spread over the four around (column + flow_x, row + flow_y); averages of what arrives."""
    n, _, height, width = x.shape
    columns, rows = cells(x)
    columns, rows = columns + flow[:, 0], rows + flow[:, 1]
    left, top = columns.detach().floor(), rows.detach().floor()
    values = torch.cat([x, torch.ones_like(x[:, :1])], 1).flatten(2)
    total = torch.zeros_like(values)
    for column, across in ((left, 1 - (columns - left)), (left + 1, columns - left)):
        for row, down in ((top, 1 - (rows - top)), (top + 1, rows - top)):
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            place = (row * width + column).where(inside, 0).long().view(n, 1, -1)
            weight = (across * down).where(inside, 0).view(n, 1, -1)
            total = total.scatter_add(2, place.expand_as(values), values * weight)
    weight = total[:, -1:]
    return (total[:, :-1] / weight.where(weight != 0, 1)).view_as(x)


def masked_warp(x: Tensor, flow: Tensor) -> Tensor:
    """`warp`; zero where any part comes from outside."""
    inside = warp(torch.ones_like(x[:, :1]), flow) >= 0.9999
    return warp(x, flow) * inside


def pwc_warp(x: Tensor, flow: Tensor) -> Tensor:
    """The warp in PWC-Net, whose flow is too large by N / (N - 1): places of pixels and flow differ in convention."""
    height, width = x.shape[2:]
    columns, rows = cells(x)
    across = (2 * columns + 1) / width - 1 + flow[:, 0] / ((width - 1) / 2)
    down = (2 * rows + 1) / height - 1 + flow[:, 1] / ((height - 1) / 2)
    both = torch.cat([x, torch.ones_like(x[:, :1])], 1)
    both = F.grid_sample(both, torch.stack([across, down], 3), mode="bilinear", align_corners=False)
    return both[:, :-1] * (both[:, -1:] > 0.999)


# PWC-Net

LEVELS = ("One", "Two", "Thr", "Fou", "Fiv", "Six")
PYRAMID = (16, 32, 64, 96, 128, 196)
DENSE = (128, 128, 96, 64, 32)
REFINER = (128, 128, 128, 96, 64, 32, 2)


def leaky() -> nn.Module:
    return nn.LeakyReLU(0.1)


class Extractor(nn.Module):
    def __init__(self, widths: tuple[int, ...], channels: int = 3):
        super().__init__()
        for name, a, b in zip(LEVELS, (channels, *widths), widths):
            layers = conv(a, b, 3, 2), leaky(), conv(b, b, 3), leaky(), conv(b, b, 3), leaky()
            self.add_module(f"net{name}", nn.Sequential(*layers))

    def forward(self, x: Tensor) -> list[Tensor]:
        """Finest first."""
        outputs = []
        for module in self.children():
            x = module(x)
            outputs.append(x)
        return outputs


class Decoder(nn.Module):
    def __init__(self, width: int, coarser: int | None, dense: tuple[int, ...], scale: float):
        """Maps of `width` channels; the next coarser level has `coarser` features; flow times `scale` is in pixels."""
        super().__init__()
        self.scale, size = scale, 81
        if coarser is not None:
            self.netUpflow = nn.ConvTranspose2d(2, 2, 4, 2, 1)
            self.netUpfeat = nn.ConvTranspose2d(coarser, 2, 4, 2, 1)
            size += width + 4
        self.dense = LEVELS[: len(dense)]
        for name, growth in zip(self.dense, dense):
            self.add_module(f"net{name}", nn.Sequential(conv(size, growth, 3), leaky()))
            size += growth
        self.netSix = nn.Sequential(conv(size, 2, 3))
        self.features = size

    def forward(self, first: Tensor, second: Tensor, before: tuple[Tensor, Tensor] | None) -> tuple[Tensor, Tensor]:
        """Flow and features from the coarser level."""
        if before is None:
            features = F.leaky_relu(correlation(first, second), 0.1)
        else:
            flow, up = self.netUpflow(before[0]), self.netUpfeat(before[1])
            similar = F.leaky_relu(correlation(first, pwc_warp(second, flow * self.scale)), 0.1)
            features = torch.cat([similar, first, flow, up], 1)
        for name in self.dense:
            features = torch.cat([self.get_submodule(f"net{name}")(features), features], 1)
        return self.netSix(features), features


class Refiner(nn.Module):
    def __init__(self, features: int, widths: tuple[int, ...]):
        super().__init__()
        layers: list[nn.Module] = []
        for a, b, dilation in zip((features, *widths), widths, (1, 2, 4, 8, 16, 1, 1)):
            layers += [nn.Conv2d(a, b, 3, padding=dilation, dilation=dilation), leaky()]
        self.netMain = nn.Sequential(*layers[:-1])

    def forward(self, x: Tensor) -> Tensor:
        return self.netMain(x)


class PwcNet(nn.Module):
    """Images of sides in multiples of 64; flow at a quarter of their size, in 20ths of pixels."""

    def __init__(
        self,
        pyramid: tuple[int, ...] = PYRAMID,
        dense: tuple[int, ...] = DENSE,
        refiner: tuple[int, ...] = REFINER,
    ):
        super().__init__()
        self.netExtractor = Extractor(pyramid)
        # From the coarsest level to the second.
        self.order, coarser = LEVELS[:0:-1], None
        for k in range(5, 0, -1):
            decoder = Decoder(pyramid[k], coarser, dense, 20 / 2 ** (k + 1))
            self.add_module(f"net{LEVELS[k]}", decoder)
            coarser = decoder.features
        self.netRefiner = Refiner(coarser, refiner)

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        pairs = list(zip(self.netExtractor(first), self.netExtractor(second)))
        before = None
        for name, pair in zip(self.order, pairs[::-1]):
            before = self.get_submodule(f"net{name}")(*pair, before)
        flow, features = before
        return flow + self.netRefiner(features)


# FloRNN


class ResidualBlock(nn.Module):
    def __init__(self, width: int):
        super().__init__()
        self.conv1, self.conv2 = conv(width, width, 3, bias=False), conv(width, width, 3, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv2(F.relu(self.conv1(x)))


class Recurrence(nn.Module):
    def __init__(self, channels: int, features: int, blocks: int):
        super().__init__()
        self.first_conv = conv(2 * channels + features, features, 3, bias=False)
        self.resblocks = nn.Sequential(*(ResidualBlock(features) for _ in range(blocks)))

    def forward(self, image: Tensor, noise: Tensor, state: Tensor) -> Tensor:
        return self.resblocks(self.first_conv(torch.cat([image, noise, state], 1)))


class Output(nn.Module):
    def __init__(self, features: int, channels: int):
        super().__init__()
        first, last = conv(2 * features, 2 * features, 3, bias=False), conv(2 * features, channels, 3, bias=False)
        self.convs = nn.Sequential(first, nn.ReLU(), last)

    def forward(self, x: Tensor) -> Tensor:
        return self.convs(x)


class FloRnn(nn.Module):
    def __init__(
        self,
        channels: int = 3,
        features: int = 64,
        blocks: int = 15,
        forward_count: int = 9,
        border_ratio: float = 0.1,
        pwcnet: PwcNet | None = None,
    ):
        super().__init__()
        self.features, self.forward_count, self.border_ratio = features, forward_count, border_ratio
        self.pwcnet = (pwcnet or PwcNet()).requires_grad_(False)
        self.forward_rnn = Recurrence(channels, features, blocks)
        self.backward_rnn = Recurrence(channels, features, blocks)
        self.d = Output(features, channels)
        for module in (self.forward_rnn, self.backward_rnn, self.d):
            for weight in module.parameters():
                nn.init.kaiming_normal_(weight, nonlinearity="relu")
                weight.data = weight.data.clamp(-1, 1) * 0.2

    @torch.no_grad()
    def flow(self, a: Tensor, b: Tensor) -> Tensor:
        """From pixels of `a` to their places in `b`."""
        height, width = a.shape[2:]
        padded = [-(-size // 64) * 64 for size in (height, width)]
        flow = self.pwcnet(resize(a, *padded), resize(b, *padded))
        factors = torch.tensor([width / padded[1], height / padded[0]]).to(a)
        return resize(flow, height, width) * 20 * factors[:, None, None]

    def forward(self, x: Tensor, noise: Tensor | None = None) -> Tensor:
        """`noise` are deviations, as large as x; none are zeros."""
        frames, count = x.shape[1], self.forward_count
        high, wide = (int(self.border_ratio * size) for size in x.shape[3:])

        def expand(image: Tensor) -> Tensor:
            return F.pad(image, (wide, wide, high, high))

        def crop(image: Tensor) -> Tensor:
            return image[:, :, high : image.shape[2] - high, wide : image.shape[3] - wide]

        # Reflected at the last frame.
        order = [*range(frames), *range(frames - 2, frames - 2 - count, -1)]
        video = [x[:, t] for t in order]
        noises = [torch.zeros_like(image) if noise is None else noise[:, t] for t, image in zip(order, video)]
        # One in the strips around the image.
        border = 1 - expand(torch.ones_like(x[:, 0, :1]))
        zero = x.new_zeros(x.shape[0], self.features, *x.shape[3:])
        backward = self.backward_rnn(video[0], noises[0], zero)
        forward = self.forward_rnn(video[0], noises[0], zero)
        queue: list[tuple[Tensor, Tensor]] = []
        outputs = []
        for i in range(1, frames + count):
            ahead = expand(self.flow(video[i - 1], video[i]))
            splatted = splat_average(expand(backward), ahead)
            queue.append((splatted, ahead))
            backward = self.backward_rnn(video[i], noises[i], crop(splatted))
            if i < count:
                continue
            mimicked = backward
            for around, flow in reversed(queue):
                mimicked = crop(masked_warp(around * border + expand(mimicked), flow))
            outputs.append(self.d(torch.cat([forward, mimicked], 1)))
            j = i - count + 1
            forward = masked_warp(forward, self.flow(video[j], video[j - 1]))
            forward = self.forward_rnn(video[j], noises[j], forward)
            queue.pop(0)
        return torch.stack(outputs, 1)


# Training


def loss(second: Tensor, truth: Tensor) -> Tensor:
    """Of the second frame alone."""
    return ((second - truth[:, 1]) ** 2).sum() / (2 * second.shape[0])


if __name__ == "__main__":
    network = FloRnn()
    state = network.state_dict()
    print(f"{sum(p.numel() for p in network.parameters())} parameters,")
    print(f"  {len(state)} entries of {sum(t.numel() for t in state.values())} values")
    for name, module in network.named_children():
        print(f"  {name}: {sum(p.numel() for p in module.parameters())}")
