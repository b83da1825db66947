# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "safetensors"]
# ///
"""Give the coarser levels of a window network new initial values, without a ReLU at their beginning.

    python scripts/convert/linear_entries.py crates/qudi-cli/weights/diffusion.safetensors start.safetensors
    qudi train window --init start.safetensors --data DATA -o RUN

In weights of the recipe `window` without `linear_entries`, the levels at a quarter and an eighth of the
resolution may be dead (docs/notes/network/dead-levels.md): they hand a constant to the finest level, whatever
the input. This script keeps the constant, and replaces these levels by ones that can learn. What they add is
small at first: `up.0` starts at a tenth of its usual size.

The constant is the one of dead levels. Levels that compute something lose it.
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
        values = {name: file.get_tensor(name).astype(np.float32) for name in file.keys()}
        metadata = dict(file.metadata() or {})
    description = json.loads(metadata.get("qudi", "{}"))
    network = description.get("network", {})
    if network.get("kind") != "window":
        sys.exit(f"{arguments.weights}: these are no weights of a window network")
    if network.get("linear_entries"):
        sys.exit(f"{arguments.weights}: these weights have linear entries already")
    network["linear_entries"] = True
    random = np.random.default_rng(arguments.seed)
    for part in PARTS:
        renew(values, f"{part}.hourglass.", random)
    metadata["qudi"] = json.dumps(description, separators=(",", ":"))
    half = {name: value.astype(np.float16) for name, value in values.items()}
    save_file(half, arguments.output, metadata=metadata)


def renew(values: dict[str, np.ndarray], hourglass: str, random: np.random.Generator) -> None:
    """Replace the coarser levels of one hourglass."""

    def draw(name: str, scale: float) -> None:
        shape = values[hourglass + name].shape
        bound = scale * np.sqrt(6 / np.prod(shape[1:]))
        values[hourglass + name] = random.uniform(-bound, bound, shape).astype(np.float32)

    block = f"{hourglass}decoder.1.blocks.0."
    constant = values[block + "second.weight"].sum((2, 3)) @ np.maximum(values[block + "first.bias"], 0)
    constant = constant + values[block + "second.bias"]
    values[hourglass + "up.0.bias"] += values[hourglass + "up.0.weight"][:, :, 0, 0] @ constant
    for level in LEVELS:
        draw(f"{level}.entry.weight", LINEAR)
        draw(f"{level}.blocks.0.first.weight", 1.0)
        draw(f"{level}.blocks.0.second.weight", SECOND)
        for bias in ("entry", "blocks.0.first", "blocks.0.second"):
            values[f"{hourglass}{level}.{bias}.bias"][:] = 0
    draw("up.1.weight", LINEAR)
    values[hourglass + "up.1.bias"][:] = 0
    draw("up.0.weight", FIRST_STEP)


if __name__ == "__main__":
    main()
