"""The stubs agree with the module, and the package with its types."""

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("mypy")
FOLDER = Path(__file__).parents[1] / "python"
CONFIG = str(FOLDER.parent / "pyproject.toml")


def run(*arguments):
    command = [sys.executable, "-m", *arguments]
    return subprocess.run(command, cwd=FOLDER, capture_output=True, text=True)


def test_mypy_is_strict():
    checked = run("mypy", f"--config-file={CONFIG}")
    assert checked.returncode == 0, checked.stdout + checked.stderr


def test_the_stub_describes_the_module():
    checked = run("mypy.stubtest", "qudi_spad._native", f"--mypy-config-file={CONFIG}")
    assert checked.returncode == 0, checked.stdout + checked.stderr


def test_users_see_the_types(tmp_path):
    program = tmp_path / "user.py"
    program.write_text(
        "import numpy as np\nimport numpy.typing as npt\nimport qudi_spad as qs\n"
        "frames: npt.NDArray[np.float32] = qs.restore('a.npy', sensor='swissspad2').frames\n"
        "stream: list[npt.NDArray[np.float32]] = list(qs.restore_iter('a.npy'))\n"
        "shape: tuple[int, int, int] = qs.open('a.npy').shape\n"
    )
    checked = run("mypy", "--strict", "--config-file=", str(program))
    assert checked.returncode == 0, checked.stdout + checked.stderr
