# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "torch"]
# ///
"""Measure time and memory of the PyTorch network on the processor, as JSON, for comparison with Rust.

    python scripts/compare/network_speed.py small --threads 2             # one reverse step
    python scripts/compare/network_speed.py small --backward              # and its gradients, 128x128
    python scripts/compare/network_speed.py small --backward --bf16       # in bfloat16, channels last
    python scripts/compare/network_speed.py small --per-block
    python scripts/compare/network_speed.py small --mode steps            # the ten-step loop
    python scripts/compare/network_speed.py small --mode train --frames 7 --size 96 --batch 2

Times are medians in seconds after a warm-up. `cpu` is the sum over threads: on a shared machine the
wall clock says little, because PyTorch's threads wait for each other. `loop` times the network's calls and the
simulated measurements (NumPy) of ten steps, with flows estimated at the steps of the preset. Weights are random, as
initialised by PyTorch. `peak_mib` is the largest resident size of the whole program;
`base_mib` is its size before the first call, mostly PyTorch itself.
"""

import argparse
import json
import resource
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests/golden/generate"))
import network  # noqa: E402

PPP, EXPOSURE = 3.25, 0.45


def peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def times(run: Callable[[], object], rounds: int, warm: int = 1) -> dict:
    seconds, cpu = [], []
    for i in range(warm + rounds):
        start, cpu_start = time.perf_counter(), time.process_time()
        run()
        if i >= warm:
            seconds.append(time.perf_counter() - start)
            cpu.append(time.process_time() - cpu_start)
    fastest = min(seconds)
    return {"median": statistics.median(seconds), "fastest": fastest, "cpu": statistics.median(cpu), "rounds": rounds}


def inputs(config: dict, frames: int, size: int, batch: int) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(1)
    shape = (batch * frames, 1, size, size)
    rand = lambda: torch.rand(shape, generator=generator)
    x = {name: rand() for name in ("u", "y_sim", "u_sim")}
    x["guide"] = torch.rand((batch * frames, network.guide_planes(config), size, size), generator=generator)
    x |= {"flag": torch.ones(batch), "x_t": torch.randn(shape, generator=generator), "x0_prev": 2 * rand() - 1}
    sensor = torch.tensor([network.sensor_numbers(PPP, EXPOSURE)] * batch)
    return x | {"t": torch.tensor([500] * batch), "sensor": sensor}


def per_block(model: network.Qudi, x: dict[str, Tensor], frames: int, rounds: int) -> dict[str, dict]:
    measured = [x[name] for name in ("guide", "y_sim", "u_sim", "flag")]
    d, g = model.pre(*measured)
    images = (2 * d - 1, x["x_t"], x["x0_prev"], x["flag"])
    noisy = network.Preconditioned(*images, 2 * model.errors(g, x["guide"]), x["t"], frames)
    low, high = model.low(x["u"], x["u_sim"], d, frames), model.high(noisy.residual, noisy.earlier, frames)
    variance = network.mean_variance(x["sensor"], frames)
    clean = x["guide"][:, :1]
    flows = model.flow(d, clean, variance, frames)
    fused = model.fusion(low, high, g, flows, frames)
    blocks = {
        "pre": lambda: model.pre(*measured),
        "low": lambda: model.low(x["u"], x["u_sim"], d, frames),
        "high": lambda: model.high(noisy.residual, noisy.earlier, frames),
        "flow": lambda: model.flow(d, clean, variance, frames),
        "fusion": lambda: model.fusion(low, high, g, flows, frames),
        "unet": lambda: model.unet(noisy, x["guide"], fused, x["t"], x["sensor"], frames),
    }
    return {name: times(run, rounds) for name, run in blocks.items()}


def backward(model: network.Qudi, x: dict[str, Tensor], frames: int) -> None:
    model.zero_grad()
    x0, d, _ = model(**x, frames=frames)
    network.loss(x0, d, x["u"]).backward()


def train(model: network.Qudi, x: dict[str, Tensor], frames: int, adam: torch.optim.Adam) -> None:
    """Run a training step without a first pass."""
    backward(model, x, frames)
    torch.nn.utils.clip_grad_norm_(model.parameters(), 0.05)
    adam.step()


def loop(model: network.Qudi, x: dict[str, Tensor], frames: int, flow_steps: list[int], ancestral: bool) -> dict:
    rng = np.random.default_rng(1)
    generator = torch.Generator().manual_seed(2)
    simulating = 0.0

    def measure(k: int, t: int, estimate: Tensor) -> tuple[Tensor, Tensor]:
        nonlocal simulating
        start = time.perf_counter()
        ppp = network.light(PPP, t)
        counts = network.expose(rng, ((estimate + 1) / 2).numpy(), ppp, EXPOSURE)
        y = torch.from_numpy(counts.astype(np.float32) / network.FULL_SCALE)
        u = torch.from_numpy(network.linear(ppp, EXPOSURE)[counts])
        simulating += time.perf_counter() - start
        return y, u

    noise = lambda k: torch.randn(x["u"].shape, generator=generator)
    start = time.perf_counter()
    run = network.sample(model, x["u"], x["guide"], x["sensor"], frames, flow_steps, noise, measure, ancestral=ancestral)
    steps = len(list(run))
    return {"seconds": time.perf_counter() - start, "simulating": simulating, "steps": steps}


def main() -> None:
    parser = argparse.ArgumentParser(description="Times the PyTorch network.")
    parser.add_argument("preset")
    parser.add_argument("--mode", choices=["step", "steps", "train"], default="step")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--size", type=int, help="256, with --backward 128")
    parser.add_argument("--frames", type=int, default=11)
    parser.add_argument("--batch", type=int, default=1, help="bursts at once")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--backward", action="store_true", help="time forward and backward together")
    parser.add_argument("--per-block", action="store_true")
    parser.add_argument("--bf16", action="store_true", help="autocast to bfloat16, convolutions channels last")
    parser.add_argument("--ancestral", action="store_true", help="sampler of --mode steps")
    args = parser.parse_args()

    torch.set_num_threads(args.threads)
    torch.manual_seed(0)
    size = args.size or (128 if args.backward else 256)
    config = network.load(args.preset)
    model = network.Qudi(config)
    if args.bf16:
        for module in model.modules():
            if isinstance(module, torch.nn.Conv2d):
                module.to(memory_format=torch.channels_last)
        torch.autocast("cpu", torch.bfloat16).__enter__()
    x = inputs(config, args.frames, size, args.batch)
    result = {"preset": args.preset, "threads": args.threads, "size": size, "frames": args.frames, "bf16": args.bf16}
    result |= {"torch": torch.__version__, "parameters": sum(p.numel() for p in model.parameters())}
    result["base_mib"] = peak_mib()
    if args.mode == "train":
        adam = torch.optim.Adam(model.parameters(), lr=1e-4)
        result["train"] = times(lambda: train(model, x, args.frames, adam), args.rounds)
    elif args.backward:
        result["forward_backward"] = times(lambda: backward(model, x, args.frames), args.rounds)
    else:
        with torch.inference_mode():
            if args.mode == "steps":
                result["loop"] = loop(model, x, args.frames, config["flow"]["steps"], args.ancestral)
            elif args.per_block:
                result["blocks"] = per_block(model, x, args.frames, args.rounds)
            else:
                result["forward"] = times(lambda: model(**x, frames=args.frames), args.rounds)
    result["peak_mib"] = peak_mib()
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
