# /// script
# requires-python = ">=3.11"
# dependencies = ["torch"]
# ///
"""Spk2ImgNet in PyTorch, for golden values.

Zhao, Xiong, Liu, Wang, Zhang, Huang: Spk2ImgNet: Learning to Reconstruct Dynamic Scene from Continuous Spike Stream,
CVPR 2021; in the size in which it was retrained as a baseline of quanta video restoration: ten frames in five
blocks of two. Sides of images are multiples of 4. Keys of `state_dict()` are those of the published weights.

The network is trained so that its outputs, divided by 0.6 (`SCALE`), are intensities.

Modulated deformable convolutions with G offset groups, as everywhere: tap k = 3 ky + kx of group g reads the map at
row + ky - 1 + dy and column + kx - 1 + dx with dy and dx channels 18 g + 2 k and 18 g + 2 k + 1 of the offsets,
bilinearly and with zeros outside, times channel 9 g + k of the mask.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

SCALE = 0.6
BLOCKS, KEY = 5, 2
NEIGHBOURS = (0, 1, 3, 4)


def conv(a: int, b: int, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(a, b, 3, stride, 1)


def leaky(x: Tensor) -> Tensor:
    return F.leaky_relu(x, 0.1)


def up2(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)


def sample(x: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """Maps [N, C, h, w] at places [N, P], bilinearly and with zeros outside: [N, C, P]."""
    n, c, h, w = x.shape
    flat, top, left = x.flatten(2), row.detach().floor(), column.detach().floor()
    total = torch.zeros(n, c, row.shape[1], dtype=x.dtype)
    for r, weight_r in ((top, 1 - (row - top)), (top + 1, row - top)):
        for q, weight_q in ((left, 1 - (column - left)), (left + 1, column - left)):
            inside = (r >= 0) & (r < h) & (q >= 0) & (q < w)
            at = (r.clamp(0, h - 1) * w + q.clamp(0, w - 1)).long()
            total = total + flat.gather(2, at[:, None].expand(-1, c, -1)) * (weight_r * weight_q * inside)[:, None]
    return total


def deform_conv(x: Tensor, offset: Tensor, mask: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """3x3, x [B, C, h, w], offset [B, 18 G, h, w], mask [B, 9 G, h, w], weight [out, C, 3, 3]."""
    b, c, h, w = x.shape
    groups = mask.shape[1] // 9
    offset, mask = offset.reshape(b * groups, 9, 2, h, w), mask.reshape(b * groups, 9, h, w)
    tap = torch.arange(9).view(9, 1, 1)
    row = torch.arange(h)[:, None] + tap // 3 - 1 + offset[:, :, 0]
    column = torch.arange(w) + tap % 3 - 1 + offset[:, :, 1]
    values = sample(x.reshape(b * groups, c // groups, h, w), row.flatten(1), column.flatten(1))
    values = (values * mask.flatten(1)[:, None]).view(b, c * 9, h * w)
    return (weight.flatten(1) @ values).view(b, -1, h, w) + bias[:, None, None]


class DeformConv(nn.Module):
    """Offsets and mask come from a convolution of a guide, which starts from zeros."""

    def __init__(self, features: int, groups: int) -> None:
        super().__init__()
        plain = conv(features, features)
        self.weight, self.bias = plain.weight, plain.bias
        self.conv_offset_mask = conv(features, 27 * groups)
        self.groups = groups
        nn.init.zeros_(self.conv_offset_mask.weight)
        nn.init.zeros_(self.conv_offset_mask.bias)

    def forward(self, x: Tensor, guide: Tensor) -> Tensor:
        offset, mask = self.conv_offset_mask(guide).split([18 * self.groups, 9 * self.groups], 1)
        return deform_conv(x, offset, torch.sigmoid(mask), self.weight, self.bias)


class ChannelAttention(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.ca_block = nn.Sequential(conv(4, 8), nn.ReLU(), conv(8, 4), nn.Sigmoid())

    def forward(self, x: Tensor) -> Tensor:
        return x * self.ca_block(x)


class Block(nn.Module):
    def __init__(self, features: int) -> None:
        super().__init__()
        self.conv1, self.conv2, self.conv3 = (conv(features, features) for _ in range(3))

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.conv3(F.relu(self.conv2(F.relu(self.conv1(x))))))


class Extractor(nn.Module):
    """Two frames to four estimates of them and to features."""

    def __init__(self, features: int, stem: int, blocks: int) -> None:
        super().__init__()
        for j in range(4):
            setattr(self, f"conv0_{j}", conv(2, stem))
            setattr(self, f"conv1_{j}", conv(stem, 1))
        self.ca = ChannelAttention()
        self.conv = conv(4, features)
        self.net = nn.Sequential(*(Block(features) for _ in range(blocks)))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        estimates = []
        for j in range(4):
            first, second = getattr(self, f"conv0_{j}"), getattr(self, f"conv1_{j}")
            estimates.append(second(F.relu(first(x))))
        estimate = torch.cat(estimates, 1)
        features = F.relu(self.conv(self.ca(estimate)))
        return estimate, features + self.net(features)


class Cascade(nn.Module):
    """Features of a neighbour, aligned to the features of the key block, from three levels of both."""

    def __init__(self, features: int, groups: int) -> None:
        super().__init__()
        two = 2 * features
        for level in (3, 2, 1):
            setattr(self, f"L{level}_offset_conv1_1", conv(two, features))
            setattr(self, f"L{level}_offset_conv2_1", conv(features if level == 3 else two, features))
            setattr(self, f"L{level}_dcnpack_1", DeformConv(features, groups))
            if level < 3:
                setattr(self, f"L{level}_offset_conv3_1", conv(features, features))
                setattr(self, f"L{level}_fea_conv_1", conv(two, features))
        self.cas_offset_conv1, self.cas_offset_conv2 = conv(two, features), conv(features, features)
        self.cas_dcnpack = DeformConv(features, groups)

    def forward(self, neighbour: list[Tensor], key: list[Tensor]) -> Tensor:
        """Levels, the finest first."""
        offset = leaky(self.L3_offset_conv1_1(torch.cat([neighbour[2], key[2]], 1)))
        offset = leaky(self.L3_offset_conv2_1(offset))
        aligned = leaky(self.L3_dcnpack_1(neighbour[2], offset))
        for level in (2, 1):
            part = lambda name: getattr(self, f"L{level}_{name}_1")
            n, k = neighbour[level - 1], key[level - 1]
            own = leaky(part("offset_conv1")(torch.cat([n, k], 1)))
            own = leaky(part("offset_conv2")(torch.cat([own, 2 * up2(offset)], 1)))
            offset = leaky(part("offset_conv3")(own))
            aligned = part("fea_conv")(torch.cat([part("dcnpack")(n, offset), up2(aligned)], 1))
            # No activation at the finest level.
            aligned = leaky(aligned) if level == 2 else aligned
        offset = leaky(self.cas_offset_conv1(torch.cat([aligned, key[0]], 1)))
        return leaky(self.cas_dcnpack(aligned, leaky(self.cas_offset_conv2(offset))))


class Align(nn.Module):
    def __init__(self, features: int, groups: int) -> None:
        super().__init__()
        self.fea_L2_conv1, self.fea_L3_conv1 = conv(features, features, 2), conv(features, features, 2)
        self.fea_L2_conv2, self.fea_L3_conv2 = conv(features, features), conv(features, features)
        self.pcd_align = Cascade(features, groups)

    def levels(self, x: Tensor) -> list[Tensor]:
        half = leaky(self.fea_L2_conv2(leaky(self.fea_L2_conv1(x))))
        return [x, half, leaky(self.fea_L3_conv2(leaky(self.fea_L3_conv1(half))))]

    def forward(self, neighbour: Tensor, key: Tensor) -> Tensor:
        return self.pcd_align(self.levels(neighbour), self.levels(key))


class Mask(nn.Module):
    """Weights of aligned features, by what they have in common with the key block's."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.conv0 = conv(2 * features, features)
        self.conv1, self.conv2 = conv(features, features), conv(features, features)
        self.prelu0, self.prelu1 = nn.PReLU(), nn.PReLU()

    def forward(self, aligned: Tensor, key: Tensor) -> Tensor:
        x = self.prelu0(self.conv0(torch.cat([aligned, key], 1)))
        return torch.sigmoid(self.conv2(self.prelu1(self.conv1(x))))


class Spk2ImgNet(nn.Module):
    """`features` must be a multiple of `groups`, the offset groups."""

    def __init__(self, features: int = 64, stem: int = 16, blocks: int = 10, groups: int = 8) -> None:
        super().__init__()
        self.extractor = Extractor(features, stem, blocks)
        for k in NEIGHBOURS:
            setattr(self, f"mask{k}", Mask(features))
        self.rec_conv0 = conv(BLOCKS * features, 3 * features)
        self.rec_conv1, self.rec_conv2 = conv(3 * features, features), conv(features, 1)
        self.pcd_align = Align(features, groups)

    def forward(self, x: Tensor) -> tuple[Tensor, list[Tensor]]:
        """Frames [B, 10, H, W] to the image [B, 1, H, W] and five estimates [B, 4, H, W], one per block."""
        estimates, features = zip(*(self.extractor(pair) for pair in x.split(2, 1)))
        key, joined = features[KEY], []
        for k in range(BLOCKS):
            if k == KEY:
                joined.append(key)
                continue
            aligned = self.pcd_align(features[k], key)
            joined.append(aligned * getattr(self, f"mask{k}")(aligned, key))
        image = F.relu(self.rec_conv0(torch.cat(joined, 1)))
        return self.rec_conv2(F.relu(self.rec_conv1(image))), list(estimates)


def loss(image: Tensor, estimates: list[Tensor], truth: Tensor) -> Tensor:
    """Mean absolute error of the image to frame 5 of `truth` [B, 10, H, W], and 0.02 times twenty others.

    Those are of each channel of the estimates, to frames 1, 3, 5, 7 and 9.
    """
    total = F.l1_loss(image / SCALE, truth[:, 5:6])
    for k, estimate in enumerate(estimates):
        for channel in estimate.split(1, 1):
            total = total + 0.02 * F.l1_loss(channel / SCALE, truth[:, 2 * k + 1 : 2 * k + 2])
    return total
