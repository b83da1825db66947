# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "safetensors", "torch"]
# ///
"""Golden values of QUIVER, FloRNN and RVRT for the Rust tests, in tests/golden/learned.

    python tests/golden/generate/learned/more_goldens.py [FILE ...]

Files are as in `network_goldens.py`, with gradients of more than 64 values cut. The networks are those of
`quiver.py`, `flornn.py` and `rvrt.py`; `about.config` has `network` and sizes that are arguments there, others are
as published. Parameters have the names of weight files, without a prefix, and PyTorch's layout: 3-D convolutions
of RVRT have weights of five dimensions. Some are `uniform.parameter(full name)` times a power of two, by the end of
the name (FACTORS; not those of `pwcnet.netExtractor.`), so that flows are some tenths of a pixel to some pixels. In
`pwcnet.` weights of more than one dimension are multiplied by 1.5 as well, as leaky ReLUs halve the variance. All
factors are applied in float32.

Means and deviations are those of the networks, not made up. PWC-Net has no gradients. Of the dense blocks of
QUIVER's `predenoise`, which are one, the files know `rdbs.0` alone.

`loss` is a case of the training loss of the outputs and `truth`, its only output, of shape [1].

- `quiver`, `quiver_loss`, `quiver_long` (more frames than a window): `clean` are the pre-denoised frames.
- `flornn`: `flow` is that of images `a` to images `b`; others give the second frame.
- `rvrt`, `rvrt_loss` (with three channels).
- `parts`: operations, which `about.operation` names. Flows of `splat`, `warp_masked` and `warp_pwc` have no gradient.
- `blocks`: parts of networks with parameters of their own.
"""

import sys
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import flornn
import network_goldens
import numpy as np
import quiver
import rvrt
import torch
import torch.nn.functional as F
import warping
from network_goldens import File, Tensors, kinks, spread
from torch import Tensor, nn
from uniform import parameter

FACTORS = {
    "basic_module.8.weight": 2,
    "conv_offset.6.weight": 1 / 8,
    "conv_offset.10.weight": 1 / 8,
    "netSix.0.weight": 1 / 8,
    "netMain.12.weight": 1 / 8,
}
EXTRACTOR = "pwcnet.netExtractor."


def scaled(name: str, shape: tuple[int, ...]) -> np.ndarray:
    values = parameter(name, shape)
    if name.startswith("pwcnet.") and len(shape) > 1:
        values = values * np.float32(1.5)
    for end, factor in FACTORS.items():
        if name.endswith(end) and not name.startswith(EXTRACTOR):
            values = values * np.float32(factor)
    return values


network_goldens.parameter = scaled
bilinear = warping.bilinear


def watched(x: Tensor, columns: Tensor, rows: Tensor, padding: str = "zeros") -> Tensor:
    """How near is the nearest coordinate, of those that have a gradient, to a whole number?"""
    beyond = 1 if padding == "zeros" else 0
    for at, cell, size in zip((columns, rows), warping.cells(x), (x.shape[3], x.shape[2])):
        at = at.detach().double()
        if at.shape[1:] == x.shape[2:]:
            kinks.reach = max(kinks.reach, (at - cell).abs().max().item())
        bends = (at > -0.5 - beyond) & (at < size - 0.5 + beyond) & (at != at.round())
        if columns.requires_grad and bends.any():
            kinks.nearest = min(kinks.nearest, (at - at.round()).abs()[bends].min().item())
    return bilinear(x, columns, rows, padding)


warping.bilinear = watched


class LearnedFile(File):
    def __init__(self, name: str):
        super().__init__(name, 64)
        self.folder = "learned"


def image(*shape: int, scale: float = 0.5) -> dict:
    """The scale of some is chosen such that few values are near kinks of activations and of warps."""
    return spread(shape, 0.5, scale)


def feature(*shape: int) -> dict:
    return spread(shape, 0.0, 1.0)


def only(loss: Callable[[Tensors, Tensors], Tensor]) -> Callable[[Tensors, Tensors], Tensor]:
    """A loss which is the only output of its case."""

    def run(outputs: Tensors, inputs: Tensors) -> Tensor:
        total = loss(outputs, inputs)
        outputs.clear()
        outputs["loss"] = total.reshape(1)
        return total

    return run


# Networks

QUIVER = {"features": 16, "blocks": 2, "past": 2, "future": 1}
IMAGES = ("clean", "full", "half", "quarter")


def quiver_file(name: str, shape: tuple[int, ...], scale: float, training: bool = False) -> File:
    file = LearnedFile(name)
    net = quiver.Quiver(**QUIVER)
    run = lambda x: dict(zip(IMAGES, net(x)))
    about = {"config": {"network": "quiver"} | QUIVER}
    if not training:
        file.case("forward", run, {"x": image(*shape, scale=scale)}, net, about=about)
        return file
    loss = lambda y, values: quiver.loss(tuple(y.values()), values["truth"], QUIVER["past"], QUIVER["future"])
    inputs = {"x": image(*shape, scale=scale), "truth": image(*shape)}
    file.case("loss", run, inputs, net, "", about, ("truth",), only(loss))
    return file


def flornn_file() -> File:
    file = LearnedFile("flornn")
    sizes = {"channels": 3, "features": 8, "blocks": 1, "forward_count": 2, "border_ratio": 0.1}
    net = flornn.FloRnn(**sizes)
    about = {"config": {"network": "flornn"} | sizes}
    pwcnet = nn.ModuleDict({"pwcnet": net.pwcnet})
    inputs = {"a": image(2, 3, 11, 23), "b": image(2, 3, 11, 23)}
    file.case("flow", lambda a, b: {"flow": net.flow(a, b)}, inputs, pwcnet, "", about, ("a", "b"))
    run = lambda x: {"y": net(x)[:, 1]}
    file.case("forward", run, {"x": image(1, 4, 3, 11, 23)}, net, about=about)
    loss = only(lambda outputs, values: flornn.loss(outputs["y"], values["truth"]))
    inputs = {"x": image(2, 4, 3, 20, 12), "truth": image(2, 4, 3, 20, 12)}
    file.case("loss", run, inputs, net, "", about, ("truth",), loss)
    return file


def rvrt_file(training: bool = False) -> File:
    file = LearnedFile("rvrt_loss" if training else "rvrt")
    sizes = {"channels": 3 if training else 1, "features": 12, "blocks": 1}
    net = rvrt.Rvrt(**sizes)
    about = {"config": {"network": "rvrt"} | sizes}
    run = lambda x: {"y": net(x)}
    if not training:
        # Quarters of 4 rows (less than a window) and 9 columns (more than one).
        file.case("forward", run, {"x": image(1, 6, 1, 16, 36)}, net, about=about)
        return file
    loss = only(lambda outputs, values: rvrt.loss(outputs["y"], values["truth"]))
    inputs = {"x": image(2, 4, 3, 16, 20, scale=0.475), "truth": image(2, 4, 3, 16, 20)}
    file.case("loss", run, inputs, net, "", about, ("truth",), loss)
    return file


# Parts


class Kernel(nn.Module):
    """Weight and bias of a convolution."""

    def __init__(self, *shape: int):
        super().__init__()
        self.weight, self.bias = nn.Parameter(torch.zeros(shape)), nn.Parameter(torch.zeros(shape[0]))


def sampling_cases(file: File) -> None:
    kernel = Kernel(6, 8, 3, 3)
    run = lambda x, offset, mask: {"y": warping.deform_conv(x, offset, mask, kernel.weight, kernel.bias, 4)}
    inputs = {"x": feature(2, 8, 5, 7), "offset": spread((2, 72, 5, 7), 0.1, 2.0), "mask": image(2, 36, 5, 7)}
    file.case("deform_conv", run, inputs, kernel, about={"operation": "deformable convolution", "groups": 4})
    inputs = {"x": feature(2, 3, 5, 8), "flow": spread((2, 2, 5, 8), 0.1, 2.5)}
    for padding in ("zeros", "border"):
        about = {"operation": "warp", "padding": padding}
        file.case(f"warp_{padding}", lambda x, flow: {"y": warping.warp(x, flow, padding)}, inputs, about=about)
    about = {"operation": "warp, zero where any part comes from outside"}
    run = lambda x, flow: {"y": flornn.masked_warp(x, flow)}
    file.case("warp_masked", run, inputs, about=about, constant=("flow",))
    about = {"operation": "warp in PWC-Net"}
    file.case("warp_pwc", lambda x, flow: {"y": flornn.pwc_warp(x, flow)}, inputs, about=about, constant=("flow",))
    about = {"operation": "averages of pixels brought by flow"}
    run = lambda x, flow: {"y": flornn.splat_average(x, flow)}
    file.case("splat", run, inputs, about=about, constant=("flow",))
    inputs = {"first": feature(2, 3, 5, 7), "second": feature(2, 3, 5, 7)}
    about = {"operation": "correlation", "radius": 4}
    file.case("correlation", lambda **x: {"y": flornn.correlation(**x)}, inputs, about=about)


def resampling_cases(file: File) -> None:
    x = {"x": feature(2, 3, 4, 6)}
    about = {"operation": "bilinear, twice the size", "corners": "at centres of pixels"}
    file.case("up2_corner", lambda x: {"y": warping.up2_corner(x)}, x, about=about)
    about = {"operation": "bilinear, twice the size", "corners": "at edges of pixels"}
    file.case("up2_edge", lambda x: {"y": F.interpolate(x, scale_factor=2, mode="bilinear")}, x, about=about)
    about = {"operation": "bilinear, to another size", "corners": "at edges of pixels"}
    file.case("resize", lambda x: {"y": warping.resize(x, 7, 11)}, x, about=about)
    file.case("resize_less", lambda x: {"y": warping.resize(x, 3, 5)}, x, about=about)
    x = {"x": feature(2, 3, 8, 12)}
    for factor in (2, 4):
        about = {"operation": "bilinear, to a part of the size", "factor": factor}
        file.case(f"reduce_{factor}", lambda x: {"y": warping.reduce(x, factor)}, x, about=about)
    about = {"operation": "bicubic, to a quarter of the size"}
    file.case("bicubic", lambda x: {"y": rvrt.quarter(x)}, x, about=about)


def swin_cases(file: File) -> None:
    for name, shape, frames, shifted in (
        ("swin", (1, 2, 9, 8), 2, False),
        ("swin_shifted", (2, 2, 9, 10), 2, True),
        ("swin_flat", (1, 2, 9, 8), 1, True),
        ("swin_small", (1, 2, 4, 10), 2, True),
    ):
        layer = rvrt.SwinLayer(12, 6, (frames, 8, 8), shifted)
        about = {"operation": "layer in windows; x [B, D, H, W, C]", "width": 12, "heads": 6}
        about |= {"window": [frames, 8, 8], "shifted": shifted}
        file.case(name, lambda x: {"y": layer(x)}, {"x": feature(*shape, 12)}, layer, about=about)


def loss_cases(file: File) -> None:
    inputs = {"x": image(3, 1, 5, 7), "truth": image(3, 1, 5, 7)}
    for name, loss in (("gradient_loss", quiver.gradient_loss), ("charbonnier", rvrt.loss)):
        measure = only(lambda outputs, values: loss(values["x"], values["truth"]))
        file.case(name, lambda x: {}, inputs, about={"operation": name}, constant=("truth",), loss=measure)


def part_file() -> File:
    file = LearnedFile("parts")
    for add_cases in (sampling_cases, resampling_cases, loss_cases):
        add_cases(file)
    return file


def block_file() -> File:
    file = LearnedFile("blocks")
    swin_cases(file)

    guided = rvrt.GuidedAttention(12)
    names = ("q", "k", "v", "warped1", "warped2")
    inputs = {name: feature(2, 2, 12, 4, 5) for name in names}
    inputs |= {name: spread((2, 2, 2, 4, 5), 0.1, 1.2) for name in ("flow1", "flow2")}

    def run_guided(q: Tensor, k: Tensor, v: Tensor, **pairs: Tensor) -> Tensors:
        warped, flows = (tuple(pairs[name + n] for n in "12") for name in ("warped", "flow"))
        y, found = guided(q, k, v, warped, flows)
        return {"y": y, "flow1": found[0], "flow2": found[1]}

    about = {"operation": "guided deformable attention", "width": 12, "groups": 12, "heads": 12}
    file.case("guided", run_guided, inputs, guided, about=about)

    spynet = warping.SpyNet()
    inputs = {"ref": image(2, 1, 12, 20), "supp": image(2, 1, 12, 20)}
    run = lambda ref, supp: {f"flow_{k}": flow for k, flow in zip((1, 2, 4), spynet(ref, supp))}
    file.case("spynet", run, inputs, spynet, about={"operation": "flow", "levels": 4})

    align = quiver.Alignment(16)
    inputs = {name: feature(2, 16, 4, 5) for name in ("x", "warped", "current")}
    inputs |= {"flow": spread((2, 2, 4, 5), 0.1, 1.2)}
    about = {"operation": "deformable convolution around flow", "features": 16}
    file.case("align", lambda **x: {"y": align(**x)}, inputs, align, about=about)

    extractor = quiver.FeatureExtractor(4)
    run = lambda x: {f"y_{k}": y for k, y in zip((1, 2, 4), extractor(x))}
    about = {"operation": "features at three scales", "features": 4}
    file.case("features", run, {"x": image(2, 3, 1, 8, 12)}, extractor, about=about)

    # Values at which another form of GELU shows.
    wide = {"x": spread((2, 6, 4, 5), 0.0, 3.0)}
    dense = quiver.DenseBlock(6, 4)
    about = {"operation": "residual dense block with GELU", "width": 6, "growth": 4}
    file.case("dense", lambda x: {"y": dense(x)}, wide, dense, about=about)
    gated = quiver.GatedFusion(3)
    about = {"operation": "gated layers on channels", "features": 3}
    file.case("gated", lambda x: {"y": gated(x)}, wide, gated, about=about)

    merge = quiver.Merge(3, 4)
    about = {"operation": "maps of frames to one, attention between channels", "frames": 3, "width": 4}
    file.case("merge", lambda x: {"y": merge(x)}, {"x": feature(2, 12, 4, 5)}, merge, about=about)

    reconstructor = quiver.Reconstructor(4)
    inputs = {"h": feature(2, 16, 3, 4), "f": feature(2, 16, 3, 4), "image": image(2, 1, 3, 4)}
    run = lambda **x: dict(zip(("image", "f", "next"), reconstructor(**x)))
    about = {"operation": "image, and what the next finer scale takes in", "features": 4}
    file.case("reconstruct", run, inputs, reconstructor, about=about)
    return file


FILES: dict[str, Callable[[], File]] = {
    "parts": part_file,
    "blocks": block_file,
    "quiver": lambda: quiver_file("quiver", (2, 4, 1, 8, 12), 0.493),
    "quiver_loss": lambda: quiver_file("quiver_loss", (1, 4, 1, 12, 16), 0.496, True),
    "quiver_long": lambda: quiver_file("quiver_long", (1, 6, 1, 8, 12), 0.429),
    "flornn": flornn_file,
    "rvrt": rvrt_file,
    "rvrt_loss": lambda: rvrt_file(True),
}


def main() -> None:
    torch.set_num_threads(1)
    for name in sys.argv[1:] or FILES:
        FILES[name]().save()


if __name__ == "__main__":
    main()
