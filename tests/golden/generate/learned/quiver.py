# /// script
# requires-python = ">=3.11"
# dependencies = ["torch"]
# ///
"""QUIVER in PyTorch, written from a description.

"Quanta Video Restoration", P. Chennuri, Y. Chi, E. Jiang, G. M. D. Godaliyadda, A. Gnanasambandam, H. R. Sheikh,
I. Gyongy, S. H. Chan, ECCV 2024.

Keys of `state_dict()` are those of the authors' weight files. Images are [B, T, 1, H, W] in [0, 1], H and W
multiples of 4.

    python tests/golden/generate/learned/quiver.py    counts the parameters
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from warping import SpyNet, conv, conv_transpose, deform_conv, reduce, warp

# Blocks


class DenseLayer(nn.Module):
    def __init__(self, a: int, b: int, activation: type[nn.Module]):
        super().__init__()
        self.conv, self.activation = conv(a, b, 3), activation()

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat([x, self.activation(self.conv(x))], 1)


class DenseBlock(nn.Module):
    """Residual dense block."""

    def __init__(self, width: int, growth: int, activation: type[nn.Module] = nn.GELU, layers: int = 3):
        super().__init__()
        sizes = [width + j * growth for j in range(layers + 1)]
        self.dense_layers = nn.Sequential(*(DenseLayer(size, growth, activation) for size in sizes[:-1]))
        self.conv1x1 = conv(sizes[-1], width, 1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv1x1(self.dense_layers(x))


class PreDenoiser(nn.Module):
    """Frame by frame; the dense blocks are one and the same."""

    def __init__(self, features: int, growth: int = 64, blocks: int = 5):
        super().__init__()
        self.sfe1, self.sfe2 = conv(1, features, 1), conv(features, features, 3)
        self.rdbs = nn.ModuleList([DenseBlock(features, growth, nn.ReLU)] * blocks)
        self.gff = nn.Sequential(conv(blocks * features, features, 1), conv(features, features, 3))
        self.out = conv(features, 1, 3)

    def forward(self, x: Tensor) -> Tensor:
        shallow = self.sfe1(x)
        f, outputs = self.sfe2(shallow), []
        for block in self.rdbs:
            f = block(f)
            outputs.append(f)
        return self.out(self.gff(torch.cat(outputs, 1)) + shallow) + x


class FeatureExtractor(nn.Module):
    def __init__(self, features: int):
        super().__init__()
        for name, stride in (("f1", 1), ("f2", 2), ("f3", 2)):
            self.add_module(name, nn.Conv3d(1, features, 5, (1, stride, stride), 2))

    def forward(self, x: Tensor) -> list[Tensor]:
        """[B, T, 1, H, W] to [B, T, C, h, w] at three scales; before the first and after the last frame are zeros."""
        volume = x.transpose(1, 2)
        half = reduce(x.flatten(0, 1), 2).unflatten(0, x.shape[:2]).transpose(1, 2)
        return [f.transpose(1, 2) for f in (self.f1(volume), self.f2(volume), self.f3(half))]


class Alignment(nn.Module):
    """A deformable convolution around flow."""

    def __init__(self, features: int, groups: int = 16):
        super().__init__()
        self.groups = groups
        self.weight = nn.Parameter(torch.empty(features, features, 3, 3))
        self.bias = nn.Parameter(torch.zeros(features))
        bound = (9 * features) ** -0.5
        nn.init.uniform_(self.weight, -bound, bound)
        layers: list[nn.Module] = []
        for a in (2 * features + 2, features, features):
            layers += [conv(a, features, 3), nn.LeakyReLU(0.1)]
        self.conv_offset = nn.Sequential(*layers, conv(features, 27 * groups, 3))
        nn.init.zeros_(self.conv_offset[-1].weight)
        nn.init.zeros_(self.conv_offset[-1].bias)

    def forward(self, x: Tensor, warped: Tensor, current: Tensor, flow: Tensor) -> Tensor:
        z = self.conv_offset(torch.cat([warped, current, flow], 1))
        offset, mask = z.split([18 * self.groups, 9 * self.groups], 1)
        offset = 10 * torch.tanh(offset) + flow.flip(1).repeat(1, 9 * self.groups, 1, 1)
        return deform_conv(x, offset, torch.sigmoid(mask), self.weight, self.bias, self.groups)

    def frames(self, x: Tensor, flow: Tensor) -> Tensor:
        """Every frame of [B, T, C, h, w] but the last one, aligned with the next; zeros come first."""
        before, after = x[:, :-1].flatten(0, 1), x[:, 1:].flatten(0, 1)
        aligned = self(before, warp(before, flow), after, flow)
        return torch.cat([torch.zeros_like(x[:, :1]), aligned.unflatten(0, (x.shape[0], -1))], 1)


class GatedFusion(nn.Module):
    def __init__(self, features: int):
        super().__init__()
        double = 2 * features
        self.fc11, self.fc12 = nn.Linear(double, double), nn.Linear(double, double)
        self.fc2 = nn.Linear(double, features)

    def forward(self, x: Tensor) -> Tensor:
        """Channels third from last."""
        v = x.movedim(-3, -1)
        return self.fc2(F.gelu(self.fc11(v)) * self.fc12(v)).movedim(-1, -3)


class Down(nn.Module):
    def __init__(self, a: int, growth: int, b: int):
        super().__init__()
        self.rdb, self.down_sampling = DenseBlock(a, growth), conv(a, b, 5, 2)

    def forward(self, x: Tensor) -> Tensor:
        return self.down_sampling(self.rdb(x))


class Shrink(nn.Module):
    def __init__(self, a: int, growth: int, b: int):
        super().__init__()
        self.rdb, self.shrink = DenseBlock(a, growth), conv(a, b, 3)

    def forward(self, x: Tensor) -> Tensor:
        return self.shrink(self.rdb(x))


class DenseChain(nn.Module):
    def __init__(self, width: int, growth: int, blocks: int):
        super().__init__()
        self.RDBs = nn.ModuleList(DenseBlock(width, growth) for _ in range(blocks))
        self.conv1x1, self.conv3x3 = conv(blocks * width, width, 1), conv(width, width, 3)

    def forward(self, x: Tensor) -> Tensor:
        outputs = []
        for block in self.RDBs:
            x = block(x)
            outputs.append(x)
        return self.conv3x3(self.conv1x1(torch.cat(outputs, 1)))


class Cell(nn.Module):
    """The recurrent cell, from the first frame to the last."""

    def __init__(self, features: int, blocks: int):
        super().__init__()
        n = features
        self.F_B01, self.F_B01_fuse = conv(1, n, 5), conv(2 * n, 4 * n, 1)
        self.F_B02, self.F_B03 = conv(1, n, 3), conv(1, n, 3)
        self.F_B1 = Down(4 * n, n, 4 * n)
        self.F_B2 = Down(6 * n, 3 * n // 2, 4 * n)
        self.F_R = nn.Sequential(Shrink(8 * n, n, 4 * n), DenseChain(4 * n, 2 * n, blocks - 1))
        self.F_h = nn.Sequential(conv(4 * n, 2 * n, 3), DenseBlock(2 * n, 2 * n), conv(2 * n, 2 * n, 3))

    def forward(self, x: Tensor, fused: list[Tensor], state: Tensor) -> tuple[Tensor, ...]:
        h1 = self.F_B01_fuse(torch.cat([self.F_B01(x), fused[0]], 1))
        h2 = self.F_B1(h1)
        h3 = self.F_B2(torch.cat([h2, self.F_B02(reduce(x, 2)), fused[1]], 1))
        h3 = self.F_R(torch.cat([h3, self.F_B03(reduce(x, 4)), fused[2], state], 1))
        return h1, h2, h3, self.F_h(h3)


class ChannelAttention(nn.Module):
    """Attention between channels."""

    def __init__(self, width: int):
        super().__init__()
        depthwise = nn.Conv2d(width, width, 3, padding=1, groups=width, bias=False)
        self.get_qkv = nn.Sequential(depthwise, conv(width, 3 * width, 1, bias=False))
        self.project_out = conv(width, width, 1, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        q, k, v = self.get_qkv(x).flatten(2).chunk(3, 1)
        weights = (F.normalize(q, dim=2) @ F.normalize(k, dim=2).transpose(1, 2)).softmax(2)
        return self.project_out((weights @ v).view_as(x))


class Merge(nn.Module):
    """Maps of a window of frames, the one of interest last, to one map."""

    def __init__(self, frames: int, width: int):
        super().__init__()
        self.conv = conv(frames * width, frames * width, 3, bias=False)
        self.spat_att = ChannelAttention(frames * width)
        self.conv1x1 = conv(frames * width, width, 1, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        y = self.conv(x)
        return self.conv1x1(self.spat_att(y) + y)


class ChannelWeights(nn.Module):
    def __init__(self, width: int, middle: int):
        super().__init__()
        ends = conv(width, middle, 1, bias=False), conv(middle, width, 1, bias=False)
        self.conv_du = nn.Sequential(ends[0], nn.ReLU(), ends[1], nn.Sigmoid())

    def forward(self, x: Tensor) -> Tensor:
        return x * self.conv_du(x.mean((2, 3), keepdim=True))


class ChannelBlock(nn.Module):
    def __init__(self, width: int, reduction: int = 16):
        super().__init__()
        self.CA = ChannelWeights(width, width // reduction)
        self.body = nn.Sequential(conv(width, width, 1), nn.GELU(), conv(width, width, 3))

    def forward(self, x: Tensor) -> Tensor:
        return self.CA(self.body(x)) + x


class Reconstructor(nn.Module):
    def __init__(self, features: int):
        super().__init__()
        n, gelu = features, nn.GELU
        self.conv1x1, self.cab = conv(8 * n, 8 * n, 1), ChannelBlock(8 * n)
        convs = conv(8 * n, 8 * n, 3), conv(8 * n, 6 * n, 3), conv(6 * n, 4 * n, 3)
        self.flast = nn.Sequential(convs[0], gelu(), convs[1], gelu(), convs[2], gelu(), conv_transpose(4 * n, 4 * n))
        convs = conv(8 * n, 6 * n, 3), conv(6 * n, 4 * n, 3), conv(4 * n, 2 * n, 3), conv(2 * n, n, 3), conv(n, 1, 3)
        self.out = nn.Sequential(convs[0], gelu(), convs[1], gelu(), convs[2], gelu(), convs[3], convs[4])
        self.upconv_out = conv_transpose(1, 1)

    def forward(self, h: Tensor, f: Tensor, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Image, and what the next finer scale takes in."""
        a = self.cab(self.conv1x1(torch.cat([h, f], 1)))
        out = self.out(a) + image
        return out, self.flast(a), self.upconv_out(out)


class Quiver(nn.Module):
    def __init__(self, features: int = 64, blocks: int = 12, past: int = 5, future: int = 5, growth: int = 64):
        super().__init__()
        self.past, self.future, self.features = past, future, features
        self.predenoise = PreDenoiser(features, growth)
        self.spynet = SpyNet()
        self.extractor, self.preden_extractor = FeatureExtractor(features), FeatureExtractor(features)
        for scale in (1, 2, 3):
            self.add_module(f"alignfuse_{scale}", GatedFusion(features))
        self.forward_cell = Cell(features, blocks)
        self.spatial_att = Merge(past + 1 + future, 4 * features)
        self.recons3, self.recons12 = Reconstructor(features), Reconstructor(features)
        self.pa_deform = Alignment(features)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Pre-denoised frames, and the result at full, half and quarter size."""
        batch, frames, _, height, width = x.shape
        clean = self.predenoise(x.flatten(0, 1)).unflatten(0, (batch, frames))
        flows = self.spynet(clean[:, 1:].flatten(0, 1), clean[:, :-1].flatten(0, 1))
        aligned = []
        for extractor, video in ((self.preden_extractor, clean), (self.extractor, x)):
            aligned.append([self.pa_deform.frames(f, flow) for f, flow in zip(extractor(video), flows)])
        fuse = self.alignfuse_1, self.alignfuse_2, self.alignfuse_3
        fused = [module(torch.cat(pair, 2)) for module, *pair in zip(fuse, *aligned)]
        state = x.new_zeros(batch, 2 * self.features, height // 4, width // 4)
        maps = []
        for t in range(frames):
            *found, state = self.forward_cell(x[:, t], [f[:, t] for f in fused], state)
            maps.append(found)
        outputs: list[list[Tensor]] = [[], [], []]
        for i in range(self.past, frames - self.future):
            order = [*range(i - self.past, i), *range(i + 1, i + self.future + 1), i]
            h = self.spatial_att(torch.cat([maps[j][2] for j in order], 1))
            out3, f, image = self.recons3(h, torch.zeros_like(h), torch.zeros_like(h[:, :1]))
            out2, f, image = self.recons12(maps[i][1], f, image)
            out1, _, _ = self.recons12(maps[i][0], f, image)
            for scale, out in zip(outputs, (out1, out2, out3)):
                scale.append(out)
        return clean, *(torch.stack(scale, 1) for scale in outputs)


# Training


def gradient_loss(x: Tensor, y: Tensor) -> Tensor:
    """Mean |x - y|, and half the same of both Sobel derivatives, borders left out; images [N, 1, H, W]."""
    sobel = torch.tensor([[1, 0, -1], [2, 0, -2], [1, 0, -1]]).to(x)
    kernels = torch.stack([sobel, sobel.T])[:, None]
    slopes = (F.conv2d(x, kernels) - F.conv2d(y, kernels)).abs().mean((0, 2, 3))
    return (x - y).abs().mean() + 0.5 * slopes.sum()


def loss(outputs: tuple[Tensor, ...], truth: Tensor, past: int = 5, future: int = 5) -> Tensor:
    """Outputs of the network; `truth` [B, T, 1, H, W] are all frames."""
    clean, *results = (output.flatten(0, 1) for output in outputs)
    wanted = truth[:, past : truth.shape[1] - future].flatten(0, 1)
    total = 0.2 * gradient_loss(clean, truth.flatten(0, 1))
    for weight, scale, result in zip((0.85, 0.1, 0.05), (1, 2, 4), results):
        total = total + weight * gradient_loss(result, reduce(wanted, scale))
    return total


if __name__ == "__main__":
    for size in (16, 64):
        with torch.device("meta"):
            network = Quiver(size)
        state = network.state_dict()
        print(f"features {size}: {sum(p.numel() for p in network.parameters())} parameters,")
        print(f"  {len(state)} entries of {sum(t.numel() for t in state.values())} values")
        for name, module in network.named_children():
            print(f"  {name}: {sum(p.numel() for p in module.parameters())}")
