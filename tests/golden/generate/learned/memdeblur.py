# /// script
# requires-python = ">=3.11"
# dependencies = ["torch"]
# ///
"""MemDeblur in PyTorch, for golden values.

Ji, Yao: Multi-Scale Memory-Based Video Deblurring, CVPR 2022; in the size in which it was retrained as a baseline
of quanta video restoration. Keys of `state_dict()` are those of that network's weight files.

Frames [B, T, C, H, W], C three copies of a gray image, H and W multiples of 4, are restored at 1/4, 1/2 and full
size, each with sides that are rounded up to multiples of 4. Two memories hold keys and values of positions:
frames of the pass backward in time, and frames and features of the passes forward, which the passes of all scales
share. What is stored and what is read differs between training and evaluation:

- read: the softmax over all entries; in evaluation over the 20 with the largest scores (`top`);
- backward pass: keeps frames of whole multiples of 5, so training needs 5 n + 1 frames; in evaluation frames 2, 7,
  12 and so on, and the last;
- in evaluation, after each entry of a frame only the last 5 n positions stay (`memory_length`), n those of the
  frame just stored. Positions of a frame are sorted by rows, frames by time.

Batch normalisations follow the mode of the module, not that of the memory: `train()` takes statistics of batches
(and updates the running ones, once per call of an encoder), `eval()` the running ones. Every frame is one batch.

`features` (64) is the width of the propagation, the keys, the decoders and the encoders' bottlenecks; values have
4 times, the value encoders' entry half of it; growth of the dense blocks is a quarter and three eighths of it.
Down-sampled frames have 16 C channels.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

SCALES = (4, 2, 1)
# At each scale, every how many frames are stored.
EVERY = (1, 2, 5)
EVERY_BACK, FIRST_BACK = 5, 2


def conv(a: int, b: int, kernel: int = 3, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(a, b, kernel, stride, kernel // 2)


def up_conv(a: int, b: int) -> nn.ConvTranspose2d:
    return nn.ConvTranspose2d(a, b, 3, 2, 1, 1)


def resize(x: Tensor, size: tuple[int, int]) -> Tensor:
    return F.interpolate(x, size=size, mode="bilinear", align_corners=False)


def scaled(h: int, w: int, scale: int) -> tuple[int, int]:
    """Sizes of the outputs: rounded up to multiples of 4."""
    return (h // scale + 3) // 4 * 4, (w // scale + 3) // 4 * 4


class DenseLayer(nn.Module):
    def __init__(self, inputs: int, growth: int) -> None:
        super().__init__()
        self.conv = conv(inputs, growth)

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat([x, F.relu(self.conv(x))], 1)


class DenseBlock(nn.Module):
    def __init__(self, channels: int, growth: int) -> None:
        super().__init__()
        self.dense_layers = nn.Sequential(*(DenseLayer(channels + j * growth, growth) for j in range(3)))
        self.conv1x1 = conv(channels + 3 * growth, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv1x1(self.dense_layers(x))


class Down(nn.Module):
    """A dense block, then half the size and four times the channels."""

    def __init__(self, channels: int, growth: int) -> None:
        super().__init__()
        self.rdb = DenseBlock(channels, growth)
        self.down_sampling = conv(channels, 4 * channels, 5, 2)

    def forward(self, x: Tensor) -> Tensor:
        return self.down_sampling(self.rdb(x))


class Residual(nn.Module):
    def __init__(self, features: int) -> None:
        super().__init__()
        self.conv1, self.conv2 = conv(features, features), conv(features, features)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv2(F.relu(self.conv1(x)))


class Residuals(nn.Module):
    """Residual blocks, after a convolution if there are `inputs`."""

    def __init__(self, inputs: int | None, features: int, blocks: int) -> None:
        super().__init__()
        entry = [] if inputs is None else [conv(inputs, features), nn.LeakyReLU(0.1)]
        self.main = nn.Sequential(*entry, nn.Sequential(*(Residual(features) for _ in range(blocks))))

    def forward(self, x: Tensor) -> Tensor:
        return self.main(x)


class Bottleneck(nn.Module):
    def __init__(self, inputs: int, features: int) -> None:
        super().__init__()
        outputs = 4 * features
        self.conv1, self.bn1 = conv(inputs, features, 1), nn.BatchNorm2d(features)
        self.conv2, self.bn2 = conv(features, features), nn.BatchNorm2d(features)
        self.conv3, self.bn3 = conv(features, outputs, 1), nn.BatchNorm2d(outputs)
        if inputs != outputs:
            self.downsample = nn.Sequential(conv(inputs, outputs, 1), nn.BatchNorm2d(outputs))
        self.shortcut = inputs != outputs

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.bn1(self.conv1(x)))
        y = self.bn3(self.conv3(F.relu(self.bn2(self.conv2(y)))))
        return F.relu(y + (self.downsample(x) if self.shortcut else x))


class Encoder(nn.Module):
    """The beginning of ResNet-50 after residual blocks: 4 `features` channels at 1/4 of the size."""

    def __init__(self, inputs: int, width: int, features: int, blocks: int, bottlenecks: int) -> None:
        super().__init__()
        self.forward_resblocks = Residuals(inputs, width, blocks)
        self.conv1 = conv(width, features, 7, 2)
        self.bn1 = nn.BatchNorm2d(features)
        widths = [features] + [4 * features] * (bottlenecks - 1)
        self.layer1 = nn.Sequential(*(Bottleneck(c, features) for c in widths))

    def forward(self, *x: Tensor) -> Tensor:
        y = F.relu(self.bn1(self.conv1(self.forward_resblocks(torch.cat(x, 1)))))
        return self.layer1(F.max_pool2d(y, 3, 2, 1))


class KeyProjection(nn.Module):
    def __init__(self, features: int) -> None:
        super().__init__()
        self.key_proj = conv(4 * features, features)

    def forward(self, x: Tensor) -> Tensor:
        return self.key_proj(x)


class Decoder(nn.Module):
    """Four times the size, then cropped."""

    def __init__(self, features: int, blocks: int) -> None:
        super().__init__()
        self.forward_resblocks = Residuals(4 * features, features, blocks)
        self.upsample = nn.Sequential(conv(features, 16 * features), nn.PixelShuffle(4))

    def forward(self, x: Tensor, size: torch.Size) -> Tensor:
        z = self.forward_resblocks(x)
        y = self.upsample(z) + resize(z, (4 * z.shape[2], 4 * z.shape[3]))
        return y[:, :, : size[0], : size[1]]


class Bank:
    """Keys [B, K, N] and one or two values [B, V, N] of N positions."""

    def __init__(self, top: int | None, length: int | None) -> None:
        self.top, self.length = top, length
        self.keys: Tensor | None = None
        self.values: list[Tensor] = []

    def store(self, key: Tensor, *values: Tensor) -> None:
        new_key, new = key.flatten(2), [value.flatten(2) for value in values]
        if self.keys is not None:
            new_key = torch.cat([self.keys, new_key], 2)
            new = [torch.cat(pair, 2) for pair in zip(self.values, new)]
        last = new_key.shape[2] if self.length is None else self.length * key.shape[2] * key.shape[3]
        self.keys, self.values = new_key[:, :, -last:], [value[:, :, -last:] for value in new]

    def match(self, query: Tensor) -> list[Tensor]:
        """Values for the positions of a query [B, K, h, w]."""
        b, c, h, w = query.shape
        product = self.keys.transpose(1, 2) @ query.flatten(2)
        scores = (2 * product - self.keys.square().sum(1)[:, :, None]) / c**0.5
        if self.top is not None and self.top < scores.shape[1]:
            best, at = scores.topk(self.top, 1)
            weights = torch.zeros_like(scores).scatter(1, at, best.softmax(1))
        else:
            weights = scores.softmax(1)
        return [(value @ weights).view(b, -1, h, w) for value in self.values]


class Memory(nn.Module):
    def __init__(self, frame: int, features: int, blocks: int, bottlenecks: int) -> None:
        super().__init__()
        half = features // 2
        self.key_encoder = Encoder(frame, frame, features, blocks, bottlenecks)
        self.value_encoder_mem = Encoder(2 * frame, half, features, blocks, bottlenecks)
        self.value_encoder_feat = Encoder(frame + features, half, features, blocks, bottlenecks)
        self.key_proj = KeyProjection(features)
        self.decoder_mem, self.decoder_feat = Decoder(features, blocks), Decoder(features, blocks)

    def key(self, x: Tensor) -> Tensor:
        return self.key_proj(self.key_encoder(x))


class MemDeblur(nn.Module):
    def __init__(
        self,
        channels: int = 3,
        features: int = 64,
        forward_blocks: int = 30,
        backward_blocks: int = 10,
        memory_blocks: int = 2,
        bottlenecks: int = 3,
        top: int = 20,
        memory_length: int = 5,
    ) -> None:
        super().__init__()
        frame, self.features, self.top, self.memory_length = 16 * channels, features, top, memory_length
        # Beside a frame's own features: of another frame, two of what is read from memory, and propagated.
        carried, leaky = frame + 3 * features, lambda: nn.LeakyReLU(0.1)
        self.downsampling = nn.Sequential(
            conv(channels, channels, 5), Down(channels, features // 4), Down(4 * channels, features * 3 // 8)
        )
        self.upsampling = nn.Sequential(
            up_conv(features, features // 2),
            leaky(),
            up_conv(features // 2, features // 4),
            leaky(),
            conv(features // 4, channels, 5),
        )
        inputs = [frame + features + carried + (frame if s else 0) for s in range(len(SCALES))]
        self.forward_input_convs = nn.ModuleList(nn.Sequential(conv(n, features), leaky()) for n in inputs)
        self.forward_resblocks = Residuals(None, features, forward_blocks)
        self.backward_resblocks = Residuals(2 * frame + 2 * features, features, backward_blocks)
        self.fusion = conv(2 * features, features, 1)
        # In the weight files, but without use.
        self.conv_hr, self.conv_last = conv(features, features), conv(features, channels)
        self.memory = Memory(frame, features, memory_blocks, bottlenecks)

    def forward(self, x: Tensor, training: bool) -> list[Tensor]:
        """The restored frames [B, T, C, h, w] of the three scales, the coarsest first; mode of the memory."""
        frames, memory = x.unbind(1), self.memory
        zeros = lambda like, n: like.new_zeros(like.shape[0], n, *like.shape[2:])
        new_bank = lambda: Bank(None, None) if training else Bank(self.top, self.memory_length)
        last, size = len(frames) - 1, x.shape[3:]
        own = [self.downsampling(frame) for frame in frames]
        keys = [memory.key(f) for f in own]
        back, ahead = new_bank(), new_bank()
        future: list[Tensor] = []
        for i in range(last, -1, -1):
            f = own[i]
            if i == last:
                joined = [f, zeros(f, f.shape[1] + 2 * self.features)]
            else:
                joined = [f, own[i + 1], memory.decoder_feat(back.match(keys[i])[0], f.shape[2:]), future[0]]
            features = self.backward_resblocks(torch.cat(joined, 1))
            if i % EVERY_BACK == (0 if training else FIRST_BACK) or (i == last and not training):
                back.store(keys[i], memory.value_encoder_feat(f, features))
            future.insert(0, features)
        results: list[Tensor] = []
        for s, scale in enumerate(SCALES):
            outputs: list[Tensor] = []
            for i, frame in enumerate(frames):
                image, f, key = frame, own[i], keys[i]
                if scale > 1:
                    image = resize(frame, scaled(*size, scale))
                    f = self.downsampling(image)
                    key = memory.key(f)
                joined = [f, memory.decoder_feat(back.match(key)[0], f.shape[2:])]
                if s:
                    joined.append(self.downsampling(resize(results[-1][:, i], image.shape[2:])))
                if i == 0:
                    joined.append(zeros(f, f.shape[1] + 3 * self.features))
                else:
                    images, read = ahead.match(key)
                    joined += [before, memory.decoder_feat(read, f.shape[2:]), features]
                    joined.append(memory.decoder_mem(images, f.shape[2:]))
                features = self.forward_resblocks(self.forward_input_convs[s](torch.cat(joined, 1)))
                fused = self.fusion(torch.cat([resize(future[i], f.shape[2:]), features], 1))
                output = self.upsampling(F.leaky_relu(fused, 0.1)) + image
                if i % EVERY[s] == 0:
                    values = memory.value_encoder_mem(f, self.downsampling(output))
                    ahead.store(key, values, memory.value_encoder_feat(f, features))
                before = f
                outputs.append(output)
            results.append(torch.stack(outputs, 1))
        return results


def loss(outputs: list[Tensor], truth: Tensor) -> Tensor:
    """Charbonnier's of the three scales, added: mean sqrt(d^2 + 1e-6), truth [B, T, C, H, W] resized bilinearly."""
    total = torch.zeros_like(truth[0, 0, 0, 0, 0])
    for output in outputs:
        b, t, c, h, w = output.shape
        target = resize(truth.flatten(0, 1), (h, w)).view(output.shape)
        total = total + ((output - target).square() + 1e-6).sqrt().mean()
    return total
