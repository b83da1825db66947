# /// script
# requires-python = ">=3.10"
# dependencies = ["numpy", "photoncube==0.3.14", "visionsim==0.1.0a2"]
# ///
"""Open a packed burst of qudi in photoncube and visionsim and compare every pixel.

    python scripts/compare/interop.py path/to/qudi

The burst is 130 x 203 pixels, so that rows end inside a byte. photoncube supports widths of whole
bytes only, and is compared on a second burst of 128 x 208.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np


def simulate(qudi: str, folder: Path, size: str, *more: str) -> None:
    command = [qudi, "simulate", "scene:text", "--size", size, "--frames", "40", "--sensor", "spad512s"]
    command += ["--ppp", "1.5", "--seed", "5", "--force", "--quiet", *more]
    subprocess.run(command, cwd=folder, check=True)


def main() -> None:
    qudi = str(Path(sys.argv[1]).resolve())
    folder = Path(tempfile.mkdtemp())

    simulate(qudi, folder, "130x203", "-o", "frames.npy", "--visionsim")
    simulate(qudi, folder, "130x203", "-o", "plain.npy", "--unpacked")
    plain = np.load(folder / "plain.npy")
    assert plain.shape == (40, 130, 203) and set(np.unique(plain)) == {0, 1}
    unpacked = np.unpackbits(np.load(folder / "frames.npy"), axis=2)[:, :, :203]
    assert (unpacked == plain).all()
    print("numpy       packed == unpacked, 40 x 130 x 203")

    from visionsim.dataset import Dataset

    dataset = Dataset.from_path(folder, mode="npy")
    assert len(dataset) == 40
    for t in range(40):
        _, frame, _ = dataset[t]
        assert (np.squeeze(frame) == plain[t]).all(), t
    print("visionsim   40 frames equal, 130 x 203")

    from photoncube import PhotonCube

    simulate(qudi, folder, "128x208", "-o", "cube.npy")
    simulate(qudi, folder, "128x208", "-o", "cube-plain.npy", "--unpacked")
    plain = np.load(folder / "cube-plain.npy")
    assert PhotonCube.open(str(folder / "cube.npy")).shape == (40, 128, 26), "photoncube's shape"
    pngs = folder / "png"
    pngs.mkdir()
    command = ["photoncube", "preview", "-i", str(folder / "cube.npy"), "--img-dir", str(pngs)]
    command += ["--burst-size", "1", "--step", "1"]
    subprocess.run([str(Path(sys.executable).parent / command[0]), *command[1:]], check=True, capture_output=True)
    from PIL import Image

    files = sorted(pngs.glob("*.png"))
    assert len(files) == 40, len(files)
    for t, file in enumerate(files):
        image = np.asarray(Image.open(file).convert("L"))
        assert ((image > 127) == (plain[t] > 0)).all(), t
    print("photoncube  40 previews equal, 128 x 208")
    convert_swissspad2(qudi, folder)


def convert_swissspad2(qudi: str, folder: Path) -> None:
    """Convert files of 8 MiB with both converters, half and full array, and compare them byte by byte."""
    rng = np.random.default_rng(9)
    photoncube = str(Path(sys.executable).parent / "photoncube")
    for name, more, own in (("half", [], "swissspad2"), ("full", ["--full-array"], "swissspad2-full")):
        raw = folder / name
        raw.mkdir()
        for k in range(2):
            # About a quarter of the bits set: the product of two random bytes.
            bits = rng.integers(0, 256, (2, 8 << 20), dtype=np.uint8)
            (bits[0] & bits[1]).tofile(raw / f"filename{k}.bin")
        theirs, ours = folder / f"{name}-photoncube.npy", folder / f"{name}-qudi.npy"
        subprocess.run([photoncube, "convert", "-i", raw, "-o", theirs, *more], check=True, capture_output=True)
        command = [qudi, "convert", raw, "-o", ours, "--format", own, "--quiet"]
        subprocess.run(command, check=True)
        expected = np.load(theirs)
        assert (np.load(ours) == expected).all(), name
        print(f"photoncube  SwissSPAD2 {name} array converted alike, {expected.shape} bytes")


if __name__ == "__main__":
    main()
