# /// script
# requires-python = ">=3.11"
# dependencies = ["torch"]
# ///
"""A student and its two teachers, after Chi et al., for golden values.

Chi, Gnanasambandam, Koltun, Chan: Dynamic Low-light Imaging with Quanta Image Sensors, ECCV 2020, and for the
kernel prediction Mildenhall, Barron, Chen, Sharlet, Ng, Carroll: Burst Denoising with Kernel Prediction Networks,
CVPR 2018. The authors' code and sizes are not public: this is a network in their spirit, and its results are ours.

Decided here:

- Student and teachers are the same network. Frames are the channels of the input [B, T, H, W], sides multiples of 8.
- The extractor is four 3x3 convolutions, each with ReLU. The U-Net has four levels; a level is two 3x3 convolutions,
  each with ReLU, between them 2x2 means on the way down; on the way up the nearest cells are repeated 2x2 and
  joined with the features of the same size, the repeated ones first. A last 3x3 convolution gives the kernels.
- Channel (t K + ky) K + kx of these weighs frame t at (row + ky - K // 2, column + kx - K // 2), zero outside. No
  softmax. The image is the mean of the filtered frames.
- Reconstruction: mean squared error of the image, and 100 * 0.9998^iteration times that of all filtered frames, each
  compared with the one clean image.
- Teachers learn reconstruction alone: the motion teacher from clean bursts with motion, the denoising teacher
  from noisy bursts without. The student learns from noisy bursts with motion: reconstruction plus, for each teacher,
  0.1 times (mean squared difference of the extractors' outputs + that of the features at the bottom). The
  clean image is the same for all three. Teachers are constant then.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

LEVELS = 4
AUXILIARY, DECAY = 100.0, 0.9998
MATCH = 0.1


def conv(a: int, b: int) -> nn.Conv2d:
    return nn.Conv2d(a, b, 3, padding=1)


def double(a: int, b: int) -> nn.Sequential:
    return nn.Sequential(conv(a, b), nn.ReLU(), conv(b, b), nn.ReLU())


def apply_kernels(x: Tensor, kernels: Tensor, size: int) -> Tensor:
    """Frames [B, T, H, W], each filtered by its kernels [B, T K^2, H, W]."""
    b, t, h, w = x.shape
    kernels = kernels.view(b, t, size, size, h, w)
    padded = F.pad(x, [size // 2] * 4)
    result = torch.zeros_like(x)
    for ky in range(size):
        for kx in range(size):
            result = result + kernels[:, :, ky, kx] * padded[:, :, ky : ky + h, kx : kx + w]
    return result


class Network(nn.Module):
    """Student or teacher: `features` channels, twice as many at each level below."""

    def __init__(self, frames: int = 11, features: int = 64, kernel: int = 5) -> None:
        super().__init__()
        self.kernel = kernel
        widths = [features << k for k in range(LEVELS)]
        inputs = [frames] + [features] * 3
        self.extractor = nn.ModuleList(conv(n, features) for n in inputs)
        self.down = nn.ModuleList(double(a, b) for a, b in zip([features, *widths], widths))
        # The coarsest first.
        pairs = list(zip(widths[1:], widths))[::-1]
        self.up = nn.ModuleList(double(a + b, b) for a, b in pairs)
        self.kernels = conv(features, frames * kernel * kernel)

    def features(self, x: Tensor) -> tuple[Tensor, list[Tensor]]:
        """Output of the extractor, and of every level on the way down."""
        for layer in self.extractor:
            x = F.relu(layer(x))
        levels = [self.down[0](x)]
        for level in list(self.down)[1:]:
            levels.append(level(F.avg_pool2d(levels[-1], 2)))
        return x, levels

    def forward(self, x: Tensor) -> dict[str, Tensor]:
        """`image` [B, 1, H, W], filtered `frames`, and what is matched: `extracted` and `bottom`."""
        extracted, levels = self.features(x)
        y = levels[-1]
        for level, skip in zip(self.up, levels[-2::-1]):
            y = level(torch.cat([F.interpolate(y, scale_factor=2), skip], 1))
        frames = apply_kernels(x, self.kernels(y), self.kernel)
        return {"image": frames.mean(1, keepdim=True), "frames": frames, "extracted": extracted, "bottom": levels[-1]}


def reconstruction(result: dict[str, Tensor], truth: Tensor, iteration: int) -> Tensor:
    """Loss of teachers; iterations count from 0."""
    frames = F.mse_loss(result["frames"], truth.expand_as(result["frames"]))
    return F.mse_loss(result["image"], truth) + AUXILIARY * DECAY**iteration * frames


def match(student: dict[str, Tensor], teacher: dict[str, Tensor]) -> Tensor:
    """Distance of features of the student to the features of a teacher, which is constant."""
    return sum(F.mse_loss(student[key], teacher[key].detach()) for key in ("extracted", "bottom"))


class Training(nn.Module):
    """The three networks."""

    def __init__(self, **sizes: int) -> None:
        super().__init__()
        self.student, self.motion, self.denoising = (Network(**sizes) for _ in range(3))
        self.motion.requires_grad_(False)
        self.denoising.requires_grad_(False)

    def loss(self, noisy: Tensor, clean: Tensor, still: Tensor, truth: Tensor, iteration: int) -> Tensor:
        """Bursts: noisy with motion, clean with the same motion, noisy without any."""
        result = self.student(noisy)
        matched = match(result, self.motion(clean)) + match(result, self.denoising(still))
        return reconstruction(result, truth, iteration) + MATCH * matched
