"""The package and the program give the same bytes."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import qudi_spad as qs

PACKAGE = Path(qs.__file__).parents[1]


def qudi(*arguments, **options):
    environment = {**os.environ, "PYTHONPATH": str(PACKAGE)}
    command = [sys.executable, "-m", "qudi_spad", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=environment, **options)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures")
    scene = ["scene:text", "--size=64x64", "--seed=5"]
    assert qudi("simulate", *scene, "--ppp=9.75", f"-o{folder}/burst.npy").returncode == 0
    binary = ["--sensor=swissspad2", "--ppp=0.5", "--frames=154", "--speed=0.02"]
    assert qudi("simulate", *scene, *binary, f"-o{folder}/bits.npy").returncode == 0
    return folder


@pytest.mark.filterwarnings("ignore::qudi_spad.CaptureWarning")
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("burst.npy", {}),
        ("burst.npy", {"method": "qudi-diffusion", "steps": 2, "samples": 2, "passes": 2, "seed": 7}),
        ("burst.npy", {"method": "qbp", "ppp": 4.0, "every": 3, "tonemap": "srgb"}),
        ("bits.npy", {"sum": 7, "method": "qbp", "crop": "8:56,0:64"}),
        ("bits.npy", {"sensor": "spad512s", "sum": 14, "method": "mle", "mask": "none"}),
    ],
)
def test_restoring(folder, tmp_path, name, options):
    flags = [f"--{key.replace('_', '-')}={value}" for key, value in options.items()]
    uncertain = options.get("method", "qudi").startswith("qudi")
    flags += [f"--uncertainty={tmp_path}/sigma.npy"] if uncertain else []
    run = qudi("--json", "restore", folder / name, *flags, f"-o{tmp_path}/frames.npy")
    assert run.returncode == 0, run.stderr
    result = qs.restore(folder / name, **options)
    assert result.frames.tobytes() == np.load(tmp_path / "frames.npy").tobytes()
    if uncertain:
        assert result.sigma.tobytes() == np.load(tmp_path / "sigma.npy").tobytes()
    printed = json.loads(run.stdout)
    assert result.manifest == {"settings": printed["settings"], "results": printed["results"]}


def test_arrays_are_restored_as_their_files(folder, tmp_path):
    counts = np.load(folder / "burst.npy")
    np.save(tmp_path / "bare.npy", counts)
    flags = ["--sensor=qudi-paper", "--method=qbp", "--ppp=9.75"]
    assert qudi("restore", tmp_path / "bare.npy", *flags, f"-o{tmp_path}/frames.npy").returncode == 0
    frames = qs.restore(counts, sensor="qudi-paper", method="qbp", ppp=9.75).frames
    assert frames.tobytes() == np.load(tmp_path / "frames.npy").tobytes()


def test_simulating(tmp_path):
    scene = ["scene:gratings", "--size=32x48", "--frames=4", "--seed=9", "--ppp=5"]
    assert qudi("simulate", *scene, f"-o{tmp_path}/burst.npy").returncode == 0
    counts, record = qs.simulate("scene:gratings", size=(32, 48), frames=4, seed=9, ppp=5)
    assert np.array_equal(counts, np.load(tmp_path / "burst.npy"))
    assert record["simulation"] == json.loads((tmp_path / "burst.npy.json").read_text())["simulation"]


def test_the_program_is_whole():
    version = qudi("--version")
    assert version.returncode == 0 and qs.__version__ in version.stdout
    missing = qudi("restore", "missing.npy", "-oout.npy")
    assert missing.returncode == 2 and "help:" in missing.stderr
    assert qudi("nonsense").returncode == 2
    assert qudi().returncode == 2
