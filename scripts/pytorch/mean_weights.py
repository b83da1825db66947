"""Weights that learn, their running mean, and the file that both come from and the mean goes to."""

import json
import sys
from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests/golden/generate"))
from network import with_former_keys  # noqa: E402

EMA = 0.999  # configs/small.toml

# Parts of parameter names, and their former names, by which these programs know them. `qudi` reads both.
FORMER_PARTS = {"stages": "drafts", "uncertainty": "error", "weighting": "trust", "weighted_in": "trusted_in"}


def former_name(name: str) -> str:
    return ".".join(FORMER_PARTS.get(part, part) for part in name.split("."))


class MeanWeights:
    """Reads a weight file. `learn` names the weights that learn; the others are written as they were."""

    def __init__(self, weights: str) -> None:
        with safe_open(weights, "pt") as file:
            self.about = json.loads(file.metadata()["qudi"])
            self.about["network"] = with_former_keys(self.about["network"])
            self.about.pop("kind", None)  # follows from the weights
            self.tensors = {former_name(name): file.get_tensor(name).float() for name in file.keys()}

    def learn(self, module: nn.Module) -> None:
        """The parameters of `module` that take gradients, by their names in the file."""
        named = module.named_parameters()
        self.learning: dict[str, Tensor] = {name: value for name, value in named if value.requires_grad}
        self.mean = {name: value.detach().clone() for name, value in self.learning.items()}

    def swap(self) -> None:
        """Exchanges weights and mean weights."""
        with torch.no_grad():
            for name, value in self.learning.items():
                kept = value.detach().clone()
                value.copy_(self.mean[name])
                self.mean[name] = kept

    def average(self, step: int) -> None:
        keep = min(EMA, 1 - 10 / (step + 10))
        with torch.no_grad():
            for name, value in self.learning.items():
                self.mean[name].lerp_(value, 1 - keep)

    def write(self, path: Path, steps: int) -> None:
        tensors = {name: value.contiguous() for name, value in (self.tensors | self.mean).items()}
        partial = path.with_suffix(".part")
        metadata = {"qudi": json.dumps({**self.about, "steps": steps}, separators=(",", ":"))}
        save_file(tensors, partial, metadata)
        partial.rename(path)
