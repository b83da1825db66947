# /// script
# requires-python = ">=3.11"
# dependencies = ["torch"]
# ///
"""RVRT in PyTorch, written from a description, of the size that the authors of QUIVER trained.

"Recurrent Video Restoration Transformer with Guided Deformable Attention", J. Liang, Y. Fan, X. Xiang, R. Ranjan,
E. Ilg, S. Green, J. Cao, K. Zhang, R. Timofte, L. Van Gool, NeurIPS 2022. Its layers are those of "Swin Transformer",
Z. Liu, Y. Lin, Y. Cao, H. Hu, Y. Wei, Z. Zhang, S. Lin, B. Guo, ICCV 2021.

Keys of `state_dict()` are those of the authors' weight files. Images are [B, T, C, H, W] in [0, 1], T even, H and W
multiples of 4. Blocks take [B, D, H, W, C] (D: frames) where it says so.

    python tests/golden/generate/learned/rvrt.py    counts the parameters
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from warping import SpyNet, deform_samples, warp

Sizes = tuple[int, int, int]
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
DIRECTIONS = ("backward_1", "forward_1", "backward_2", "forward_2")


def conv(a: int, b: int, kernel: int, stride: int = 1) -> nn.Conv3d:
    """Frame by frame, on [B, C, D, H, W]."""
    padding = kernel // 2
    return nn.Conv3d(a, b, (1, kernel, kernel), (1, stride, stride), (0, padding, padding))


def quarter(x: Tensor) -> Tensor:
    """Bicubic (a = -3/4) without a filter before it: four taps on every four pixels."""
    taps = torch.tensor([-3.0, 19, 19, -3]).to(x) / 32
    rows = x.unflatten(-2, (-1, 4)).movedim(-2, -1) @ taps
    return rows.unflatten(-1, (-1, 4)) @ taps


# Attention in shifted windows


def regions(size: int, window: int, shift: int) -> Tensor:
    """Which of up to three parts, that shifting joins in a window, a row belongs to."""
    row = torch.arange(size)
    return (row >= size - window).int() + (row >= size - shift).int() if shift else torch.zeros_like(row)


def windows(x: Tensor, sizes: Sizes) -> Tensor:
    """[B, D, H, W, C] to [windows, cells of one, C], in the order of the image."""
    b, d, h, w, c = x.shape
    x = x.view(b, d // sizes[0], sizes[0], h // sizes[1], sizes[1], w // sizes[2], sizes[2], c)
    return x.permute(0, 1, 3, 5, 2, 4, 6, 7).reshape(-1, math.prod(sizes), c)


def image_of(x: Tensor, sizes: Sizes, shape: torch.Size) -> Tensor:
    """The reverse of `windows`."""
    b, d, h, w, c = shape
    x = x.view(b, d // sizes[0], h // sizes[1], w // sizes[2], *sizes, c)
    return x.permute(0, 1, 4, 2, 5, 3, 6, 7).reshape(shape)


class WindowAttention(nn.Module):
    def __init__(self, width: int, heads: int, window: Sizes):
        super().__init__()
        self.heads = heads
        spans = [2 * size - 1 for size in window]
        self.relative_position_bias_table = nn.Parameter(torch.zeros(math.prod(spans), heads))
        places = torch.cartesian_prod(*(torch.arange(size) for size in window))
        d, h, w = (places[:, None] - places + torch.tensor(window) - 1).unbind(2)
        self.register_buffer("relative_position_index", (d * spans[1] + h) * spans[2] + w)
        self.qkv_self, self.proj = nn.Linear(width, 3 * width), nn.Linear(width, width)
        nn.init.trunc_normal_(self.relative_position_bias_table, std=0.02)

    def forward(self, x: Tensor, mask: Tensor | None) -> Tensor:
        """x [windows, cells, C]; mask [windows of one batch item, cells, cells]."""
        count, cells, width = x.shape
        q, k, v = self.qkv_self(x).view(count, cells, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        scores = (q * (width // self.heads) ** -0.5) @ k.transpose(2, 3)
        # For smaller windows, the first of the places in the full one, whatever they stood for.
        index = self.relative_position_index[:cells, :cells]
        scores = scores + self.relative_position_bias_table[index].permute(2, 0, 1)
        if mask is not None:
            scores = (scores.unflatten(0, (-1, len(mask))) + mask[:, None]).flatten(0, 1)
        return self.proj((scores.softmax(3) @ v).transpose(1, 2).flatten(2))


class Mlp(nn.Module):
    def __init__(self, width: int, hidden: int):
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(width, hidden), nn.Linear(hidden, width)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(F.gelu(self.fc1(x)))


class SwinLayer(nn.Module):
    def __init__(self, width: int, heads: int, window: Sizes, shifted: bool, ratio: int = 2):
        super().__init__()
        self.window, self.shifted = window, shifted
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attn, self.mlp = WindowAttention(width, heads, window), Mlp(width, ratio * width)

    def attend(self, x: Tensor) -> Tensor:
        shape = x.shape[1:4]
        window = tuple(min(pair) for pair in zip(self.window, shape))
        shifts = [full // 2 if self.shifted and size > full else 0 for full, size in zip(self.window, shape)]
        d, h, w = (-size % full for size, full in zip(shape, window))
        x = F.pad(x, (0, 0, 0, w, 0, h, 0, d))
        mask = None
        if any(shifts):
            x = x.roll([-shift for shift in shifts], (1, 2, 3))
            parts = [regions(*sizes) for sizes in zip(x.shape[1:4], window, shifts)]
            part = 9 * parts[0][:, None, None] + 3 * parts[1][:, None] + parts[2]
            part = windows(part[None, ..., None], window)
            mask = -100.0 * (part != part.transpose(1, 2)).to(x)
        x = image_of(self.attn(windows(x, window), mask), window, x.shape)
        x = x.roll(shifts, (1, 2, 3))
        return x[:, : shape[0], : shape[1], : shape[2]]

    def forward(self, x: Tensor) -> Tensor:
        """[B, D, H, W, C]."""
        x = x + self.attend(self.norm1(x))
        return x + self.mlp(self.norm2(x))


class LayerPair(nn.Module):
    def __init__(self, width: int, heads: int, window: Sizes):
        super().__init__()
        self.blocks = nn.Sequential(*(SwinLayer(width, heads, window, shifted) for shifted in (False, True)))


class SwinBlock(nn.Module):
    def __init__(self, width: int, heads: int, window: Sizes):
        super().__init__()
        self.residual_group, self.linear = LayerPair(width, heads, window), nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.linear(self.residual_group.blocks(x))


class Stage(nn.Module):
    """A convolution, and blocks between two norms, on [B, D, C, H, W]."""

    def __init__(self, channels: int, width: int, heads: int, window: Sizes, blocks: int):
        super().__init__()
        group = nn.Sequential(*(SwinBlock(width, heads, window) for _ in range(blocks)))
        layers = {"1": conv(channels, width, 3), "3": nn.LayerNorm(width), "5": group, "7": nn.LayerNorm(width)}
        self.main = nn.ModuleDict(layers)

    def forward(self, x: Tensor) -> Tensor:
        x = self.main["1"](x.transpose(1, 2)).movedim(1, -1)
        for name in ("3", "5", "7"):
            x = self.main[name](x)
        return x.movedim(-1, 2)


# Guided deformable attention


class GuidedAttention(nn.Module):
    """From the two frames of a clip to where the clip before has them: flow, and changes of it that it finds."""

    def __init__(self, width: int, groups: int = 12, heads: int = 12, middle: int = 64, expansion: int = 2):
        super().__init__()
        self.groups, self.heads = groups, heads
        layers: list[nn.Module] = [conv(3 * width + 4, middle, 1), nn.LeakyReLU(0.1)]
        for _ in range(4):
            layers += [conv(middle, middle, 3), nn.LeakyReLU(0.1)]
        self.conv_offset = nn.Sequential(*layers, conv(middle, 36 * groups, 1))
        wide = expansion * width
        for name in ("proj_q", "proj_k", "proj_v"):
            self.add_module(name, nn.ModuleDict({"1": nn.Linear(width, wide)}))
        self.proj = nn.ModuleDict({"1": nn.Linear(wide, width)})
        self.mlp = nn.ModuleDict({"1": Mlp(width, 2 * width)})

    def project(self, name: str, x: Tensor) -> Tensor:
        return self.get_submodule(name)["1"](x.movedim(2, -1)).movedim(-1, 2)

    def attend(self, q: Tensor, kv: Tensor, offsets: tuple[Tensor, Tensor]) -> Tensor:
        """One frame: q [B, C, H, W]; keys and values [B, 2C, H, W] of both frames before, in turn."""
        b, channels, height, width = q.shape
        samples = [deform_samples(kv[:, n], offset, self.groups).flatten(1, 2) for n, offset in enumerate(offsets)]
        both = torch.cat(samples, 2)
        k, v = both.view(b, 2, self.heads, channels // self.heads, -1, height, width).unbind(1)
        q = q.view(b, self.heads, -1, 1, height, width)
        scores = (q * k).sum(2, keepdim=True) * (channels // self.heads) ** -0.5
        return (scores.softmax(3) * v).sum(3).view_as(q[:, :, :, 0]).flatten(1, 2)

    def forward(
        self, q: Tensor, k: Tensor, v: Tensor, warped: tuple[Tensor, Tensor], flows: tuple[Tensor, Tensor]
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """All [B, 2, C, H, W]; the aligned clip, and new flows."""
        z = torch.cat([q, *warped, *flows], 2).transpose(1, 2)
        changes = (10 * torch.tanh(self.conv_offset(z))).transpose(1, 2).chunk(2, 2)
        pairs = zip(changes, flows)
        offsets = [change + flow.flip(2).repeat(1, 1, 9 * self.groups, 1, 1) for change, flow in pairs]
        q = self.project("proj_q", q)
        kv = torch.cat([self.project("proj_k", k), self.project("proj_v", v)], 2)
        frames = []
        for b in range(2):
            # The first offsets lead to the frame of the same place, the second ones to the other frame.
            frames.append(self.attend(q[:, b], kv.roll(-b, 1), (offsets[0][:, b], offsets[1][:, b])))
        x = self.project("proj", torch.stack(frames, 1))
        x = x + self.project("mlp", x)
        means = (offset.unflatten(2, (-1, 2)).mean(2).flip(2) for offset in offsets)
        return x, tuple(means)


# The whole


def warp_frames(x: Tensor, flow: Tensor) -> Tensor:
    return warp(x.flatten(0, 1), flow.flatten(0, 1)).view_as(x)


def turned(clips: list[Tensor]) -> list[Tensor]:
    """In reverse order, clips and frames."""
    return [clip.flip(1) for clip in clips[::-1]]


class Rvrt(nn.Module):
    def __init__(
        self,
        channels: int = 1,
        features: int = 144,
        blocks: int = 2,
        heads: int = 6,
        window: int = 8,
        groups: int = 12,
        attention_heads: int = 12,
        middle: int = 64,
        levels: int = 6,
    ):
        """`blocks` belong to a propagation; the first stage and the last one have one each."""
        super().__init__()
        wide = features, heads
        flat, deep = (1, window, window), (2, window, window)
        self.spynet = SpyNet(MEAN, STD, levels)
        first, second = conv(channels, features, 3, 2), conv(features, features, 3, 2)
        self.feat_extract = nn.ModuleDict({"1": first, "3": second, "6": Stage(features, *wide, flat, 1)})
        stages = {name: Stage((2 + i) * features, *wide, deep, blocks) for i, name in enumerate(DIRECTIONS)}
        self.backbone = nn.ModuleDict(stages)
        aligners = {name: GuidedAttention(features, groups, attention_heads, middle) for name in DIRECTIONS}
        self.deform_align = nn.ModuleDict(aligners)
        self.reconstruction = Stage(5 * features, *wide, flat, 1)
        self.conv_before_upsampler = nn.Sequential(conv(features, middle, 1))
        sizes = {"0": (middle, 4 * middle), "5": (middle, 4 * middle), "10": (middle, middle)}
        self.upsampler = nn.ModuleDict({name: conv(*pair, 3) for name, pair in sizes.items()})
        self.conv_last = conv(middle, channels, 3)

    def extract(self, x: Tensor) -> Tensor:
        x = x.transpose(1, 2)
        for name in ("1", "3"):
            x = F.leaky_relu(self.feat_extract[name](x), 0.1)
        return self.feat_extract["6"](x.transpose(1, 2))

    def upsample(self, x: Tensor) -> Tensor:
        x = F.leaky_relu(self.conv_before_upsampler(x.transpose(1, 2)), 0.1)
        for name in ("0", "5"):
            x = F.pixel_shuffle(self.upsampler[name](x).transpose(1, 2), 2).transpose(1, 2)
            x = F.leaky_relu(x, 0.1)
        return self.conv_last(self.upsampler["10"](x)).transpose(1, 2)

    def flows(self, x: Tensor) -> dict[str, list[Tensor]]:
        """Per direction: from every frame, as visited, but the first, to the one before."""
        small = quarter(x)
        before, after = small[:, :-1].flatten(0, 1), small[:, 1:].flatten(0, 1)
        pairs = {"backward": (before, after), "forward": (after, before)}
        found = {name: self.spynet(*pair, (1,))[0].unflatten(0, (len(x), -1)) for name, pair in pairs.items()}
        return {"backward": list(found["backward"].flip(1).unbind(1)), "forward": list(found["forward"].unbind(1))}

    def propagate(
        self,
        name: str,
        earlier: list[list[Tensor]],
        flows: list[Tensor],
        kept: list[tuple[Tensor, Tensor]],
    ) -> list[Tensor]:
        """Clips of the modules before, in the order of visiting; `kept`: flows that round 1 finds and round 2 uses."""
        first_round = not kept
        state = torch.zeros_like(earlier[0][0])
        results: list[Tensor] = []
        for i, sources in enumerate(zip(*earlier)):
            if i > 0:
                if first_round:
                    n01, n12, n23 = flows[2 * i - 2 : 2 * i + 1]
                    n02, n13 = n12 + warp(n01, n12), n23 + warp(n12, n23)
                    n03 = n23 + warp(n02, n23)
                    pair = torch.stack([n02, n13], 1), torch.stack([n12, n03], 1)
                else:
                    pair = kept[i - 1]
                warped = warp_frames(state, pair[0]), warp_frames(state.flip(1), pair[1])
                q, k = sources[-1], earlier[-1][i - 1]
                state, found = self.deform_align[name](q, k, state, warped, pair)
                if first_round:
                    kept.append(found)
            state = state + self.backbone[name](torch.cat([*sources, state], 2))
            results.append(state)
        return results

    def forward(self, x: Tensor) -> Tensor:
        flows = self.flows(x)
        lists = [list(self.extract(x).split(2, 1))]
        kept: dict[str, list[tuple[Tensor, Tensor]]] = {"backward": [], "forward": []}
        for name in DIRECTIONS:
            direction = name.split("_")[0]
            # Clips, and the frames in them, from the last to the first.
            turn = turned if direction == "backward" else list
            clips = self.propagate(name, [turn(clips) for clips in lists], flows[direction], kept[direction])
            lists.append(turn(clips))
        features = torch.cat([torch.cat(clips, 1) for clips in lists], 2)
        return x + self.upsample(self.reconstruction(features))


# Training


def loss(output: Tensor, truth: Tensor) -> Tensor:
    return ((output - truth) ** 2 + 1e-6).sqrt().mean()


if __name__ == "__main__":
    for count in (1, 3):
        network = Rvrt(count)
        state = network.state_dict()
        print(f"channels {count}: {sum(p.numel() for p in network.parameters())} parameters,")
        print(f"  {len(state)} entries of {sum(t.numel() for t in state.values())} values")
        for name, module in network.named_children():
            print(f"  {name}: {sum(p.numel() for p in module.parameters())}")
