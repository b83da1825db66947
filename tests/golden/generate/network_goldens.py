# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "safetensors", "torch"]
# ///
"""Golden values of the network for the Rust tests, in tests/golden: network, kernels (single operations), sampling.

    python tests/golden/generate/network_goldens.py [FILE ...]

Values are computed in float64 from float32 weights and inputs and rounded to float32; the program
prints how far PyTorch's own float32 is from them, and how near the warps come to a kink.

A file holds cases. Metadata `cases` is JSON, one object per case:

- `about`: what is computed, and settings (`config`: the [network] table where a block needs one);
- `inputs`: per name the `shape` and either `values`, or `offset` and `scale`: the input is
  offset + scale * uniform("input.NAME") (`uniform.py`), computed in float64, rounded to float32.
  `zero` lists indices of the first dimension (frames) that are zero instead; so is the stored
  gradient there, whatever the true one is: flow past the ends of a burst is a constant;
- `parameters`: per full name the shape (PyTorch layout); values by `uniform.parameter(full name)`;
- `outputs`: names and shapes.

Tensors of case C are named `C/output.NAME` and `C/grad.NAME`, the latter for inputs and for
parameters, by full name: the gradient of the sum over outputs of output * uniform("cotangent.NAME")
(unrounded), except where `about.loss` says otherwise. Large gradients are replaced by `C/cut.NAME`,
34 numbers: the L2 norm, the product with uniform("probe.NAME") (which sees order and sign, too) and
the first 32 values of the flattened gradient.

Flows at which a warp has a kink (whole coordinates, borders) are kept out of the inputs.

`loss` of `paper`: L(p, q) = mean (p-q)^2 + 0.01 * (mean |across| + mean |down|), where across and
down are forward differences of p - q along rows and columns, each averaged over its own number of
values; 1.0 * L((x0 + 1) / 2, truth) + 0.2 * L(d, truth), nothing clipped.

`steps`: DDIM and ancestral coefficients [10, 3] (c0, cx, sigma: x <- c0 x0 + cx x + sigma noise) in
float64, with `times` and `after` (-1: finished), and `alpha_bar` at `alpha_bar_t`. `uniform` is
uniform("input.x", 8) and `gaussian` gaussian("noise.0", [8]), to check the generator.

`sample_paper` and `sample_correction`: ten steps, one burst. x_T is `uniform.gaussian("noise.0")`
and the noise of step K (from 1; none at the last) `gaussian("noise.K")`, of shape [4, 1, 32, 32].
`counts` [4, 32, 32] are the burst, `simulated` [9, 4, 32, 32] the simulated measurements of steps 2 to
10; y = counts / 7; u = `u_table`[counts], u_sim of step K = `u_sim_table`[K - 2][counts]. The flows of
steps 1, 3 and 6 serve the steps after them. `x` and `x0` [10, 64] are x and the clipped x0 after
each step at the flat indices 61 i; `x0_last` is the result.
"""

import json
import math
import sys
from collections.abc import Callable
from pathlib import Path

import network
import numpy as np
import torch
import torch.nn.functional as F
from safetensors.torch import save_file
from schedule import alpha_bar
from torch import Tensor, nn
from uniform import affine, gaussian, parameter, uniform

OUT = network.ROOT / "tests/golden"
KERNELS = {"conv", "group_norm", "warp", "warp_cubic", "tv_flow"}
Tensors = dict[str, Tensor]


# Sizes of the golden values, and the same with every switch set as in the paper.
TINY = {
    "fold": 2,
    "pre": {"width": 8, "blocks": 2, "growth": 4, "neighbours": 4},
    "features": {"low": [4, 6, 8], "high": [4, 6, 8]},
    "flow": {"scale": 2, "levels": 3, "networks": 2, "widths": [8, 8, 8, 4], "steps": [1, 3, 6]},
    "fusion": {"level": 1, "widths": [8, 16, 16], "growth": 8},
    "unet": {
        "width": 12,
        "multipliers": [1, 2, 2],
        "blocks": 1,
        "attention": [],
        "temporal": False,
        "embedding": 32,
    },
}
PAPER = TINY | {
    "reference": "none",
    "pre": {"width": 8, "blocks": 2, "growth": 4, "neighbours": 0},
    "features": TINY["features"] | {"noisy": "image"},
    "flow": TINY["flow"] | {"registration": False},
    "unet": TINY["unet"] | {"predicts": "x0"},
}
# From photons alone, but with corrections of pre-denoised frames.
CORRECTION = PAPER | {"features": TINY["features"], "unet": TINY["unet"] | {"predicts": "correction"}}


class Kinks:
    """Watches the coordinates of every warp: how near is the nearest to a whole number?"""

    def __init__(self) -> None:
        self.nearest, self.reach, self.warp = math.inf, 0.0, network.warp

    def __call__(self, x: Tensor, flow: Tensor) -> Tensor:
        for axis, size in ((0, x.shape[3]), (1, x.shape[2])):
            f = flow.detach()[:, axis].double()
            cells = torch.arange(size, dtype=torch.float64)
            at = f + (cells if axis == 0 else cells[:, None])
            # Beyond the borders nothing bends; flow that is constant zero has no gradient.
            bends = (at > -0.5) & (at < size - 0.5) & (f != 0)
            if bends.any():
                self.nearest = min(self.nearest, (at - at.round()).abs()[bends].min().item())
            self.reach = max(self.reach, f.abs().max().item())
        return self.warp(x, flow)


kinks = network.warp = Kinks()


def full_names(module: nn.Module | None, prefix: str) -> dict[str, nn.Parameter]:
    parameters = dict(module.named_parameters()) if module else {}
    return {f"{prefix}.{name}" if prefix else name: p for name, p in parameters.items()}


def fill(module: nn.Module | None, prefix: str, dtype: torch.dtype) -> dict[str, nn.Parameter]:
    if module is not None:
        module.to(dtype)
    named = full_names(module, prefix)
    for name, p in named.items():
        p.data = torch.from_numpy(parameter(name, tuple(p.shape))).to(dtype)
        p.grad = None
    return named


def spread(shape: tuple[int, ...], offset: float = 0.0, scale: float = math.sqrt(3)) -> dict:
    return {"shape": list(shape), "offset": offset, "scale": scale}


def given(values: list) -> dict:
    return {"shape": list(np.shape(values)), "values": np.ravel(values).tolist()}


def make(name: str, spec: dict, dtype: torch.dtype) -> Tensor:
    if "values" in spec:
        values = np.array(spec["values"], np.float32)
        return torch.from_numpy(values.reshape(spec["shape"])).to(dtype)
    value = affine(f"input.{name}", tuple(spec["shape"]), spec["offset"], spec["scale"])
    value[spec.get("zero", [])] = 0
    return torch.from_numpy(value).to(dtype)


def cotangent_loss(outputs: Tensors) -> Tensor:
    total = torch.zeros((), dtype=next(iter(outputs.values())).dtype)
    for name, value in outputs.items():
        w = torch.from_numpy(uniform(f"cotangent.{name}", value.numel())).to(value.dtype)
        total = total + (value * w.view(value.shape)).sum()
    return total


def distance(a: Tensor, b: Tensor) -> float:
    """Largest difference over largest value: what a float32 implementation may be held to."""
    return ((a.double() - b).abs().max() / b.abs().max().clamp(min=1e-30)).item()


class File:
    def __init__(self, name: str, limit: int | None = None):
        """Gradients of more than `limit` values are cut (see above). `folder` is where, if not by name."""
        self.name, self.limit = name, limit
        self.folder: str | None = None
        self.tensors: Tensors = {}
        self.cases: dict[str, dict] = {}
        self.worst: dict[str, tuple[float, str]] = {"output": (0.0, "-"), "grad": (0.0, "-")}

    def case(
        self,
        case: str,
        run: Callable[..., Tensors],
        inputs: dict[str, dict],
        module: nn.Module | None = None,
        prefix: str = "",
        about: dict | None = None,
        constant: tuple[str, ...] = ("flag", "t"),
        loss: Callable[[Tensors, Tensors], Tensor] | None = None,
    ) -> Tensors:
        """`run(**inputs)` in float64 and float32; no gradients of the `constant` inputs."""
        results: dict[torch.dtype, Tensors] = {}
        for dtype in (torch.float64, torch.float32):
            parameters = fill(module, prefix, dtype)
            values = {name: make(name, spec, dtype) for name, spec in inputs.items()}
            for name, value in values.items():
                value.requires_grad_(name not in constant)
            kinks.nearest, kinks.reach = math.inf, 0.0
            outputs = run(**{name: value for name, value in values.items() if name != "truth"})
            total = loss(outputs, values) if loss else cotangent_loss(outputs)
            if total.requires_grad:
                total.backward()
            results[dtype] = {f"output.{name}": value.detach() for name, value in outputs.items()}
            for name, leaf in {**values, **parameters}.items():
                if leaf.requires_grad:
                    grad = torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
                    grad[inputs.get(name, {}).get("zero", [])] = 0
                    results[dtype][f"grad.{name}"] = grad.detach().clone()
            if dtype == torch.float64 and kinks.nearest < math.inf:
                print(f"  {self.name}/{case}: nearest kink {kinks.nearest:.1e}, flows up to {kinks.reach:.2f}")
        shapes = {name: list(value.shape) for name, value in results[torch.float64].items()}
        self.cases[case] = {
            "about": about or {},
            "inputs": inputs,
            "parameters": {name: list(p.shape) for name, p in full_names(module, prefix).items()},
            "outputs": {name.removeprefix("output."): s for name, s in shapes.items() if name.startswith("output.")},
        }
        for name, value in results[torch.float64].items():
            self.judge(case, name, results[torch.float32][name], value)
            self.add(f"{case}/{name}", value)
        return results[torch.float64]

    def judge(self, case: str, name: str, single: Tensor, double: Tensor) -> None:
        kind = name.split(".")[0]
        self.worst[kind] = max(self.worst[kind], (distance(single, double), f"{case}/{name}"))

    def add(self, name: str, value: Tensor) -> None:
        if "/grad." in name and self.limit is not None and value.numel() > self.limit:
            name = name.replace("/grad.", "/cut.")
            flat = value.flatten()
            probe = torch.from_numpy(uniform("probe." + name.split("/cut.")[1], len(flat)))
            value = torch.cat([torch.stack([flat.norm(), flat @ probe]), flat[:32]])
        self.tensors[name] = value.float().contiguous().clone()

    def save(self) -> None:
        folder = "kernels" if self.name in KERNELS else "network"
        if self.name.startswith("sample_"):
            folder = "sampling"
        folder = self.folder or folder
        (OUT / folder).mkdir(parents=True, exist_ok=True)
        path = OUT / folder / f"{self.name.removeprefix('sample_')}.safetensors"
        save_file(dict(sorted(self.tensors.items())), path, {"cases": json.dumps(self.cases)})
        errors = ", ".join(f"{kind} {e:.1e} ({where})" for kind, (e, where) in self.worst.items())
        path.chmod(0o644)
        print(f"{self.name}: {path.stat().st_size / 1000:.1f} kB; float32 against float64: {errors}")


# Operations


def conv_file() -> File:
    file = File("conv")
    flat = {"k1": (1, 1), "k3": (3, 1), "k7": (7, 1), "k3s2": (3, 2)}
    for name, (kernel, stride) in flat.items():
        for relu in (False, True):
            module = network.conv(4, 5, kernel, stride)
            act = F.relu if relu else lambda x: x
            about = {"conv": "2d", "kernel": kernel, "stride": stride, "relu": relu, "bias": True}
            file.case(
                name + "_relu" * relu,
                lambda x: {"y": act(module(x))},
                {"x": spread((3, 4, 5, 8))},
                module,
                "conv",
                about,
            )
    for stride in (1, 2):
        for frames in (3, 4):
            for relu, bias in ((False, True), (True, True), (False, False)):
                if frames == 4 and not bias:
                    continue
                module = network.conv3d(2, 3, stride, bias)
                act = F.relu if relu else lambda x: x
                about = {"conv": "3d", "kernel": 5, "strides": [1, stride, stride], "relu": relu, "bias": bias}
                about |= {"frames": frames, "layout": "x [B*N, C, h, w]; weight [out, in, frame, y, x]"}
                file.case(
                    f"3d_s{stride}_n{frames}" + "_relu" * relu + "_plain" * (not bias),
                    lambda x: {"y": act(network.planes(module(network.volume(x, frames))))},
                    {"x": spread((2 * frames, 2, 5, 7) if stride == 1 else (2 * frames, 2, 6, 8))},
                    module,
                    "conv",
                    about,
                )
    return file


def norm_file() -> File:
    file = File("group_norm")
    for channels in (12, 16):
        module = network.gn(channels)
        for silu in (False, True):
            act = F.silu if silu else lambda x: x
            x = {"x": spread((4, channels, 3, 5), 0.5)}
            about = {"groups": module.num_groups, "eps": 1e-5, "silu": silu}
            name = f"c{channels}" + "_silu" * silu
            file.case(name, lambda x: {"y": act(module(x))}, x, module, "norm", about | {"film": False})
            film = x | {"scale": spread((4, channels), scale=0.5), "shift": spread((4, channels), scale=0.5)}
            file.case(
                name + "_film",
                lambda x, scale, shift: {"y": act(module(x) * (1 + scale[:, :, None, None]) + shift[:, :, None, None])},
                film,
                module,
                "norm",
                about | {"film": True},
            )
    return file


def warp_file() -> File:
    file = File("warp")
    run = lambda x, flow: {"y": network.warp(x, flow)}
    x = {"x": spread((2, 3, 6, 9))}
    about = {"operation": "warp(x, flow), flow [B, 2, h, w], channel 0 is x"}
    zero = x | {"flow": spread((2, 2, 6, 9), scale=0.0)}
    # Zero flow is a kink everywhere: no gradient of the flow.
    file.case("zero", run, zero, about=about, constant=("flow",))
    file.case("fraction", run, x | {"flow": spread((2, 2, 6, 9), 0.1, 1.3)}, about=about)
    file.case("far", run, x | {"flow": spread((2, 2, 6, 9), 0.0, 30.0)}, about=about)
    return file


def warp_cubic_file() -> File:
    file = File("warp_cubic")
    run = lambda x, flow: {"y": network.warp_cubic(x, flow)}
    x = {"x": spread((2, 3, 6, 9))}
    about = {"operation": "bicubic warp, a = -0.75; no gradient of the flow"}
    for case, flow in (("fraction", (0.1, 1.3)), ("far", (0.0, 30.0))):
        inputs = x | {"flow": spread((2, 2, 6, 9), *flow)}
        file.case(case, run, inputs, about=about, constant=("flow",))
    return file


def tv_flow_file() -> File:
    file = File("tv_flow")
    images = {name: spread((2, 1, 10, 13), 0.5, 0.1) for name in ("reference", "neighbour")}
    inputs = images | {"start": spread((2, 2, 10, 13), 0.0, 0.5)}
    run = lambda reference, neighbour, start: {"y": network.tv_flow(reference, neighbour, start)}
    about = {"operation": "TV-L1 flow of one level"}
    file.case("level", run, inputs, about=about, constant=tuple(inputs))
    return file


def resample_file() -> File:
    file = File("resample")
    x = {"x": spread((2, 3, 4, 6))}
    file.case("up2", lambda x: {"y": network.up2(x)}, x, about={"operation": "up2"})
    file.case("pool2", lambda x: {"y": F.avg_pool2d(x, 2)}, x, about={"operation": "2x2 average pooling"})
    repeat = lambda x: {"y": F.interpolate(x, scale_factor=2, mode="nearest")}
    file.case("repeat2", repeat, x, about={"operation": "each cell repeated 2x2"})
    fold = lambda x: {"y": F.pixel_unshuffle(x, 2)}
    file.case("fold", fold, x, about={"operation": "fold, f = 2"})
    unfold = lambda x: {"y": F.pixel_shuffle(x, 2)}
    file.case("unfold", unfold, {"x": spread((2, 8, 2, 3))}, about={"operation": "unfold, f = 2"})
    for scale, target in ((4, 1), (2, 8)):
        resize = lambda x: {"y": network.resize_flow(x, scale, target)}
        about = {"operation": "flow taken to another scale", "scale": scale, "target": target}
        file.case(f"flow_{scale}_{target}", resize, {"x": spread((2, 2, 4, 8))}, about=about)
    return file


# Blocks


def variant(config: dict, **tables: dict) -> dict:
    """A configuration with some settings replaced."""
    return config | {name: config[name] | table for name, table in tables.items()}


def block_file() -> File:
    file = File("blocks", 1024)
    dense = network.DenseBlock(6, 4)
    about = {"operation": "residual dense block", "width": 6, "growth": 4}
    file.case("dense", lambda x: {"y": dense(x)}, {"x": spread((2, 6, 5, 7))}, dense, "dense", about)

    for a, b in ((12, 12), (12, 20)):
        residual = network.ResidualBlock(a, b, 5)
        about = {"operation": "residual block of the U-Net; emb [B*N, M]", "from": a, "to": b, "embedding": 5}
        inputs = {"x": spread((3, a, 3, 5)), "emb": spread((3, 5))}
        run = lambda x, emb: {"y": residual(x, emb)}
        file.case(f"residual_{a}_{b}", run, inputs, residual, "residual", about)

    x = {"x": spread((6, 12, 3, 5))}
    attention = network.Attention(12)
    about = {"operation": "attention over cells"}
    file.case("attention", lambda x: {"y": attention(x, 1)}, x, attention, "attention", about)
    temporal = network.TemporalAttention(12)
    about = {"operation": "attention over frames; the norm frame by frame", "frames": 3}
    file.case("temporal", lambda x: {"y": temporal(x, 3)}, x, temporal, "temporal", about)

    t = {"t": given([0, 1, 99, 500, 899, 999])}
    sines = lambda t: {"y": network.sinusoids(t, 32, torch.float64)}
    file.case("sinusoids", sines, t, about={"operation": "sinusoidal embedding", "size": 32})
    return file


COUNTS, LINEAR, CENTRED = (0.5, 0.5), (0.6, 0.6), (0.0, 0.9)
# Its last plane is a deviation.
GUIDE = (0.55, 0.45)


def pre_file(name: str, **settings: int) -> File:
    file = File(name, 128)
    config = variant(TINY, pre=settings)
    module = network.PreDenoiser(config)
    shape = (6, 1, 12, 20)
    measured = {"guide": spread((6, network.guide_planes(config), 12, 20), *GUIDE)}
    simulated = {"y_sim": spread(shape, *COUNTS), "u_sim": spread(shape, *LINEAR)}
    for name, flags, absent in (("with", [1, 1], []), ("without", [0, 0], range(6)), ("mixed", [1, 0], range(3, 6))):
        now = {key: spec | {"zero": list(absent)} for key, spec in simulated.items()}
        inputs = measured | now | {"flag": given(flags)}
        constant = ("flag",) if len(absent) == 0 else ("flag", "y_sim", "u_sim")
        run = lambda **x: dict(zip("dg", module(**x)))
        file.case(name, run, inputs, module, "pre", {"config": config, "frames": 3}, constant)
    return file


def error_file() -> File:
    file = File("error", 128)
    config = variant(TINY, pre={"error": True})
    module = network.ErrorHead(config)
    guide = spread((6, network.guide_planes(config), 12, 20), *GUIDE)
    inputs = {"g": spread((6, config["pre"]["width"], 6, 10), *CENTRED), "guide": guide}
    run = lambda **x: {"deviation": module(**x)}
    file.case("error", run, inputs, module, "error", {"config": config}, ("guide",))
    return file


def feature_file() -> File:
    file = File("features", 128)
    config = TINY
    shape = (6, 1, 16, 24)
    low, high = network.Low(config), network.High(config)
    inputs = {"u": spread(shape, *LINEAR), "u_sim": spread(shape, *LINEAR), "d": spread(shape, *COUNTS)}
    about = {"config": config, "frames": 3}
    run = lambda **x: {f"low_{k}": value for k, value in enumerate(low(**x, frames=3))}
    file.case("low", run, inputs, low, "low", about)
    inputs = {"residual": spread(shape), "earlier": spread(shape, *CENTRED)}
    run = lambda **x: {f"high_{k}": value for k, value in enumerate(high(**x, frames=3))}
    file.case("high", run, inputs, high, "high", about)
    return file


def sensors(*deviations: list[float]) -> dict:
    """Two sensors with these deviations of the linear estimate, as logarithms, at no and at mean light."""
    first = [0.5, 0.45, 0.8, 1.6, 0.2, 0.03, 0.375, 0, 0]
    second = [1, 0.3, 0.4, 0.1, 0.9, 1, 0.5, 1, 0.4]
    return {"sensor": given([first + deviations[0], second + deviations[1]])}


def flow_file() -> File:
    file = File("flow", 128)
    contrast = {"registration": False, "inputs": "contrast"}
    for case, flow in (("contrast", {"levels": 2, "networks": 2} | contrast),):
        config = variant(TINY, flow=flow)
        module = network.Flow(config)
        run = lambda d, clean, variance: dict(zip(("to_next", "to_prev"), module(d, clean, variance, 4)))
        inputs = {"d": spread((8, 1, 32, 48), 0.45, 6.0), "clean": spread((8, 1, 32, 48), 0.5, 7.0)}
        inputs |= {"variance": spread((8, 1, 1, 1), 120.0, 30.0)}
        about = {"config": config, "frames": 4}
        file.case(case, run, inputs, module, "flow", about, ("variance", "clean"))
    return file


def fusion_file() -> File:
    file = File("fusion", 128)
    for level in range(3):
        config = variant(TINY, fusion={"level": level, "widths": [6, 8, 10]}, flow={"scale": 4})
        module = network.Fusion(config)
        inputs: dict[str, dict] = {}
        for kind in ("low", "high"):
            for k, width in enumerate(config["features"][kind]):
                inputs[f"{kind}_{k}"] = spread((6, width, 8 >> k, 12 >> k), 0.5, 0.5)
        inputs["g"] = spread((6, config["pre"]["width"], 8, 12))
        # Frames 0..2 and 3..5 are bursts.
        inputs["to_next"] = spread((6, 2, 4, 6), 0.05, 1.3) | {"zero": [2, 5]}
        inputs["to_prev"] = spread((6, 2, 4, 6), -0.05, 1.3) | {"zero": [0, 3]}

        def run(g: Tensor, to_next: Tensor, to_prev: Tensor, **x: Tensor) -> Tensors:
            low, high = ([x[f"{kind}_{k}"] for k in range(3)] for kind in ("low", "high"))
            fused = module(low, high, g, (to_next, to_prev), 3)
            return {f"fused_{k}": value for k, value in enumerate(fused)}

        file.case(f"level_{level}", run, inputs, module, "fusion", {"config": config, "frames": 3})
    return file


def unet_file() -> File:
    file = File("unet", 128)
    tiny = TINY
    all_on = {"width": 16, "multipliers": [1, 1, 2, 2], "blocks": 2, "attention": [1, 3]}
    all_on |= {"temporal": True, "embedding": 8}
    full = variant(tiny | {"fold": 1}, unet=all_on, fusion={"widths": [3, 5, 6]})
    for name, config in (("tiny", tiny), ("all", full)):
        module = network.UNet(config)
        shape = (6, 1, 16, 24)
        inputs = {"x_t": spread(shape), "x0_prev": spread(shape, *CENTRED), "flag": given([1, 0])}
        inputs |= {"d": spread(shape, *COUNTS), "guide": spread((6, network.guide_planes(config), 16, 24), *GUIDE)}
        for k, width in enumerate(config["fusion"]["widths"]):
            scale = config["fold"] << k
            inputs[f"fused_{k}"] = spread((6, width, 16 // scale, 24 // scale), 0.5, 0.5)
        inputs |= {"t": given([700, 40]), "sensor": spread((2, 11), scale=1.0)}

        def run(**x: Tensor) -> Tensors:
            fused = [x.pop(f"fused_{k}") for k in range(3)]
            images = [2 * x["d"] - 1, x["x_t"], x["x0_prev"], x["flag"]]
            noisy = network.Preconditioned(*images, 0.6 * network.normalized_input(x["guide"])[1], x["t"], 3)
            return {"x0": module(noisy, x["guide"], fused, x["t"], x["sensor"], 3)}

        file.case(name, run, inputs, module, "unet", {"config": config, "frames": 3})
    return file


# The whole


def whole_loss(outputs: Tensors, inputs: Tensors) -> Tensor:
    """The loss of a whole network, which joins the outputs."""
    outputs["loss"] = network.loss(outputs["x0"], outputs["d"], inputs["truth"]).reshape(1)
    return outputs["loss"].sum()


def single_file(name: str, config: dict) -> File:
    """The same from photons alone."""
    file = File(name, 128)
    module = network.Qudi(config)
    shape = (8, 1, 32, 48)
    inputs = {"u": spread(shape, *LINEAR), "y": spread(shape, *COUNTS), "y_sim": spread(shape, *COUNTS)}
    inputs |= {"u_sim": spread(shape, *LINEAR), "flag": given([1, 0])}
    inputs |= {"x_t": spread(shape), "x0_prev": spread(shape, *CENTRED)}
    inputs |= {"t": given([700, 40]), "truth": spread(shape, 0.5, 0.4)}
    inputs |= sensors([0.0, -1.0], [-0.5, -1.2])

    def run(**x: Tensor) -> Tensors:
        x.pop("truth", None)
        single = network.Single.of(x["u"], x.pop("y"), x["sensor"])
        x0, d, flows = module(guide=single, **x, frames=4)
        return {"x0": x0, "d": d, "to_next": flows[0], "to_prev": flows[1]}

    about = {"config": config, "frames": 4, "loss": "1.0 L((x0 + 1) / 2, truth) + 0.2 L(d, truth)"}
    file.case(name, run, inputs, module, "", about, ("flag", "t", "truth", "sensor"), whole_loss)
    return file


def step_file() -> File:
    file = File("steps")
    times = [0, 1, 99, 199, 250, 499, 750, 899, 990, 998, 999]
    pairs = network.steps(10)
    for name in ("ddim", "ancestral"):
        rows = [network.coefficients(*pair, name == "ancestral") for pair in pairs]
        file.tensors[name] = torch.tensor(rows, dtype=torch.float64)
    file.tensors |= {"times": torch.tensor([t for t, _ in pairs]), "after": torch.tensor([a for _, a in pairs])}
    file.tensors |= {"alpha_bar_t": torch.tensor(times), "alpha_bar": torch.from_numpy(alpha_bar()[times].copy())}
    file.tensors["uniform"] = torch.from_numpy(uniform("input.x", 8))
    file.tensors["gaussian"] = torch.from_numpy(gaussian("noise.0", (8,)))
    return file


PPP, EXPOSURE, FRAMES, SIZE = 3.25, 0.45, 4, 32


def sample_file(ancestral: bool, config: dict, name: str) -> File:
    file = File(name)
    module = network.Qudi(config)
    shape = (FRAMES, 1, SIZE, SIZE)
    rng = np.random.default_rng(7)
    y, x = np.mgrid[:SIZE, :SIZE]
    scene = np.stack([0.45 + 0.35 * np.sin((x + 2 * i) / 4) * np.cos(y / 5) for i in range(FRAMES)])[:, None]
    counts = network.expose(rng, scene, PPP, EXPOSURE)
    # Any guide serves: an estimate, a noisier one, the deviation of its noise, and deviations.
    around = lambda noise: (scene + noise * rng.standard_normal(scene.shape)).astype(np.float32)
    guide = [around(0.05), around(0.1), rng.uniform(0.05, 0.15, scene.shape).astype(np.float32)]
    more = 0 if config.get("reference") == "none" else network.guide_planes(config) - len(guide)
    guide += [rng.standard_normal(scene.shape).astype(np.float32) for _ in range(more)]
    table = network.linear(PPP, EXPOSURE)
    tables = np.stack([network.linear(network.light(PPP, t), EXPOSURE) for t, _ in network.steps(10)[1:]])
    simulated: dict[int, np.ndarray] = {}
    results: dict[torch.dtype, Tensors] = {}
    for dtype in (torch.float64, torch.float32):
        fill(module, "", dtype)

        def both(counts: np.ndarray, table: np.ndarray) -> tuple[Tensor, Tensor]:
            y = (counts / network.FULL_SCALE).astype(np.float32)
            return torch.from_numpy(y).to(dtype), torch.from_numpy(table[counts]).to(dtype)

        def measure(k: int, t: int, estimate: Tensor) -> tuple[Tensor, Tensor]:
            # Drawn in the float64 run, replayed in the other.
            if k not in simulated:
                image = ((estimate + 1) / 2).numpy()
                simulated[k] = network.expose(rng, image, network.light(PPP, t), EXPOSURE)
            return both(simulated[k], tables[k - 2])

        noise = lambda k: torch.from_numpy(gaussian(f"noise.{k}", shape)).to(dtype)
        sensor = torch.tensor([network.sensor_numbers(PPP, EXPOSURE)]).to(dtype)
        y, u = both(counts, table)
        planes: Tensor | network.Single = torch.from_numpy(np.concatenate(guide, 1)).to(dtype)
        if config.get("reference") == "none":
            planes = network.Single.of(u, y, sensor)
        run = network.sample(
            module, u, planes, sensor, FRAMES, config["flow"]["steps"], noise, measure, ancestral=ancestral
        )
        with torch.no_grad():
            states = list(run)
        pick = lambda x: x.flatten()[: 61 * 64 : 61]
        results[dtype] = {name: torch.stack([pick(s[i]) for s in states]) for i, name in enumerate(("x", "x0"))}
        results[dtype] |= {"x0_last": states[-1][1], "every": torch.stack([x for _, x in states])}
    double, single = results[torch.float64], results[torch.float32]
    clipped = (double["every"].abs() == 1).double().mean().item()
    print(f"  {file.name}: {100 * clipped:.0f} % of x0 clipped")
    for name in ("x", "x0", "x0_last"):
        file.judge("sample", f"output.{name}", single[name], double[name])
        file.tensors[name] = double[name].float().contiguous().clone()
    file.tensors["guide"] = torch.from_numpy(np.concatenate(guide, 1))
    file.tensors["counts"] = torch.from_numpy(counts[:, 0].copy())
    file.tensors["simulated"] = torch.from_numpy(np.stack([simulated[k][:, 0] for k in range(2, 11)]))
    file.tensors["u_table"], file.tensors["u_sim_table"] = torch.from_numpy(table), torch.from_numpy(tables)
    about = {"config": config, "sampler": "ancestral" if ancestral else "ddim", "sensor": sensor.flatten().tolist()}
    about |= {"ppp": PPP, "exposure": EXPOSURE, "frames": FRAMES}
    file.cases["sample"] = {"about": about, "parameters": {n: list(p.shape) for n, p in module.named_parameters()}}
    return file


FILES: dict[str, Callable[[], File]] = {
    "conv": conv_file,
    "group_norm": norm_file,
    "warp": warp_file,
    "warp_cubic": warp_cubic_file,
    "tv_flow": tv_flow_file,
    "resample": resample_file,
    "blocks": block_file,
    "pre_trust": lambda: pre_file("pre_trust", motions=2, trust=4),
    "error": error_file,
    "features": feature_file,
    "flow": flow_file,
    "fusion": fusion_file,
    "unet": unet_file,
    "paper": lambda: single_file("paper", PAPER),
    "correction": lambda: single_file("correction", CORRECTION),
    "steps": step_file,
    "sample_paper": lambda: sample_file(False, PAPER, "sample_paper"),
    "sample_correction": lambda: sample_file(False, CORRECTION, "sample_correction"),
}


def main() -> None:
    torch.set_num_threads(2)
    for name in sys.argv[1:] or FILES:
        FILES[name]().save()


if __name__ == "__main__":
    main()
