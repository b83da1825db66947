# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "safetensors", "torch"]
# ///
"""Makes corrected colours by the network that `scripts/colour_network.py` trains, with weights by formula.

    python tests/golden/generate/colour.py
"""

import sys
from pathlib import Path

import torch
from safetensors.torch import save_file
from uniform import affine, parameter

ROOT = Path(__file__).resolve().parents[3]
sys.path.insert(0, str(ROOT / "scripts"))
import colour_network  # noqa: E402

HEIGHT, WIDTH = 24, 24

# Offset and scale of the planes of evidence.
PLANES = [(1.0, 0.9), *[(1.0, 0.8)] * 3, *[(0.0, 2.0)] * 3, *[(1.5, 1.4)] * 3, *[(0.2, 0.19)] * 3, (0.0, 2.0), (4.0, 3.0)]


def main():
    network = colour_network.ColourNetwork()
    weights = {name: torch.tensor(parameter(name, tuple(p.shape))) for name, p in network.state_dict().items()}
    network.load_state_dict(weights)
    planes = [affine(f"colour.{k}", (HEIGHT, WIDTH), *plane) for k, plane in enumerate(PLANES)]
    evidence = torch.tensor(planes)[None]
    # Sides become multiples of eight by mirroring the lower rows.
    evidence[:, :, 20:] = evidence[:, :, 15:19].flip(2)
    luma = torch.tensor([[0.25, 0.5, 0.25]])
    with torch.no_grad():
        output = network(colour_network.features(evidence))
        colours = colour_network.colours(evidence, luma, output)
    tensors = {"evidence": evidence[0, :, :20].contiguous(), "colours": colours[0, :, :20].contiguous()}
    path = ROOT / "tests/golden/network/colour.safetensors"
    save_file(tensors, path, {"cases": "{}"})
    path.chmod(0o644)


if __name__ == "__main__":
    main()
