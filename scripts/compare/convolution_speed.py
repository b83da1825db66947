# /// script
# requires-python = ">=3.11"
# dependencies = ["torch"]
# ///
"""Measure PyTorch's single convolutions in bfloat16, channels last, for comparison with `qudi-kernels`.

    python scripts/compare/convolution_speed.py --threads 2

Prints GFLOP/s of the forward pass (with bias and ReLU), and of forward and backward together, for the shapes of
`docs/notes/engineering/bfloat16.md`: the third fastest of seven runs. Backward counts twice the multiplications.
"""

import argparse
import time

import torch
import torch.nn.functional as F

IMAGES = 11
SHAPES = [
    (40, 40, 128, 3, 1),
    (64, 64, 128, 3, 1),
    (120, 120, 32, 3, 1),
    (16, 32, 64, 7, 1),
    (120, 48, 128, 1, 1),
    (64, 64, 128, 3, 2),
]


def third_fastest(run) -> float:
    seconds = []
    run()
    for _ in range(7):
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return sorted(seconds)[2]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=2)
    torch.set_num_threads(parser.parse_args().threads)
    for inputs, outputs, side, kernel, stride in SHAPES:
        generator = torch.Generator().manual_seed(1)
        x = torch.randn(IMAGES, inputs, side, side, generator=generator).bfloat16()
        x = x.to(memory_format=torch.channels_last).requires_grad_()
        w = torch.randn(outputs, inputs, kernel, kernel, generator=generator).mul(0.1).bfloat16()
        w = w.to(memory_format=torch.channels_last).requires_grad_()
        bias = torch.zeros(outputs, dtype=torch.bfloat16, requires_grad=True)

        def forward(x=x, w=w, bias=bias, stride=stride, kernel=kernel) -> torch.Tensor:
            return F.relu(F.conv2d(x, w, bias, stride, kernel // 2))

        def without_gradients() -> None:
            with torch.no_grad():
                forward()

        y = forward()
        gradient = torch.ones_like(y)

        def both(gradient=gradient) -> None:
            forward().backward(gradient)

        flops = 2 * IMAGES * (side // stride) ** 2 * inputs * outputs * kernel**2
        speeds = flops / third_fastest(without_gradients) / 1e9, 3 * flops / third_fastest(both) / 1e9
        print(f"{kernel}x{kernel} / {stride}, {inputs} to {outputs}, {side}: forward {speeds[0]:.0f}, both {speeds[1]:.0f}")


if __name__ == "__main__":
    main()
