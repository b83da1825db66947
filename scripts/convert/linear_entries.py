# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "safetensors"]
# ///
"""Give the coarser levels of a window network new initial values, without a ReLU at their beginning.

    python scripts/convert/linear_entries.py crates/qudi-cli/weights/diffusion.safetensors start.safetensors
    qudi train window --init start.safetensors --data DATA -o RUN

In weights of the recipe `window` without `linear_entries`, the levels at a quarter and an eighth of the
resolution may be dead (docs/notes/network/dead-levels.md): they hand a constant to the finest level, whatever
the input. This script keeps the constant, also for the learnt flow, which sees the pre-denoiser's levels, and
replaces these levels by ones that can learn. What they add is small at first: `up.0` and the flow's `compared`
start at a tenth of their usual size.

The constant is the one of dead levels, away from the border of the frame. Levels that compute something lose it.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from safetensors import safe_open
from safetensors.numpy import save_file

PARTS = ("pre", "unet")
LEVELS = ("encoder.1", "encoder.2", "decoder.1")

# Scales of initial values: a linear entry has no ReLU that halves its output's variance.
LINEAR, SECOND, FIRST_STEP = 0.7, 0.3, 0.1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("weights", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--seed", type=int, default=58)
    arguments = parser.parse_args()
    with safe_open(arguments.weights, "np") as file:
        stored = {name: file.get_tensor(name) for name in file.keys()}
        metadata = dict(file.metadata() or {})
    description = json.loads(metadata.get("qudi", "{}"))
    network = description.get("network", {})
    if network.get("kind") != "window":
        sys.exit(f"{arguments.weights}: these are no weights of a window network")
    if network.get("linear_entries"):
        sys.exit(f"{arguments.weights}: these weights have linear entries already")
    network["linear_entries"] = True
    values = {name: value.astype(np.float32) for name, value in stored.items()}
    random = np.random.default_rng(arguments.seed)
    for part in PARTS:
        renew(values, f"{part}.hourglass.", random)
    metadata["qudi"] = json.dumps(description, separators=(",", ":"))
    kept = {name: value.astype(stored[name].dtype) for name, value in values.items()}
    save_file(kept, arguments.output, metadata=metadata)


def renew(values: dict[str, np.ndarray], hourglass: str, random: np.random.Generator) -> None:
    """Replace the coarser levels of one hourglass."""

    def draw(name: str, scale: float) -> None:
        shape = values[hourglass + name].shape
        bound = scale * np.sqrt(6 / np.prod(shape[1:]))
        values[hourglass + name] = random.uniform(-bound, bound, shape).astype(np.float32)

    def constant_of(level: str) -> np.ndarray:
        block = f"{hourglass}{level}.blocks.0."
        inner = np.maximum(values[block + "first.bias"], 0)
        return values[block + "second.weight"].sum((2, 3)) @ inner + values[block + "second.bias"]

    def keep(layer: str, level: str) -> None:
        weight, bias = values[f"{layer}.weight"], values[f"{layer}.bias"]
        bias += weight[:, :, 0, 0] @ constant_of(level)
        bound = FIRST_STEP * np.sqrt(6 / weight.shape[1])
        weight[:] = random.uniform(-bound, bound, weight.shape)

    keep(f"{hourglass}up.0", "decoder.1")
    if hourglass.startswith("pre."):
        keep("flow.levels.1.compared", "decoder.1")
        keep("flow.levels.2.compared", "encoder.2")
    for level in LEVELS:
        draw(f"{level}.entry.weight", LINEAR)
        draw(f"{level}.blocks.0.first.weight", 1.0)
        draw(f"{level}.blocks.0.second.weight", SECOND)
        for bias in ("entry", "blocks.0.first", "blocks.0.second"):
            values[f"{hourglass}{level}.{bias}.bias"][:] = 0
    draw("up.1.weight", LINEAR)
    values[hourglass + "up.1.bias"][:] = 0


if __name__ == "__main__":
    main()
