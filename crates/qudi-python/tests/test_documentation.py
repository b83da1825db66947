"""The examples of the documentation and the notebooks run."""

import doctest
import re
from pathlib import Path

import numpy as np
import pytest

import qudi_spad as qs
from test_command_line import qudi

ROOT = Path(__file__).parents[3]


def test_docstrings():
    assert doctest.testmod(qs).failed == 0


def test_python_page(tmp_path, monkeypatch):
    """The blocks of docs/python.md, one after the other in one program; files are blocks that name themselves."""
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    blocks = re.findall(r"(<!-- not tested -->\n)?```python\n(.*?)```", text, re.DOTALL)
    names = {"np": np}
    for skipped, block in blocks:
        if skipped or "import dask" in block and not _has("dask.array"):
            continue
        if block.startswith("# restore.py"):
            monkeypatch.setattr("sys.argv", ["restore.py", "2"])
        exec(compile(block, "docs/python.md", "exec"), names)
    assert np.load("restored-2.npy").shape == (1, 64, 64)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("page", ["README.md", "docs/quickstart.md", "docs/formats.md"])
def test_other_pages(tmp_path, monkeypatch, page):
    """Blocks about the package, and about reading our files with NumPy alone."""
    monkeypatch.chdir(tmp_path)
    for name, sensor in [("burst.npy", "qudi-paper"), ("binary.npy", "swissspad2")]:
        options = ["--sensor", sensor, "--frames=11", "--size=64x64", "-o", name]
        assert qudi("simulate", "scene:dead-leaves", *options).returncode == 0
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL)
    assert blocks
    for block in blocks:
        names = {}
        exec(compile(block, page, "exec"), names)
        for counts in (names.get("counts"), names.get("frames")):
            assert counts is None or counts.shape == (11, 64, 64)


@pytest.mark.filterwarnings("ignore::qudi_spad.CaptureWarning")
def test_readme_of_the_package(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    qs.write("burst.npy", qs.simulate("scene:dead-leaves", frames=11, size=(64, 64))[0], bits=3)
    text = (ROOT / "crates" / "qudi-python" / "README.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    block = block.replace("progress=True", 'sensor="qudi-paper", ppp=3.25, method="qbp"')
    exec(compile(block, "README.md", "exec"), {})


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ["first-restoration", "training"])
def test_notebooks(tmp_path, monkeypatch, name):
    """The cells of a notebook, one after the other."""
    nbformat = pytest.importorskip("nbformat")
    pytest.importorskip("matplotlib").use("agg")
    monkeypatch.chdir(tmp_path)
    notebook = nbformat.read(ROOT / "docs" / "notebooks" / f"{name}.ipynb", as_version=4)
    nbformat.validate(notebook)
    names = {}
    for number, cell in enumerate(notebook.cells):
        if cell.cell_type == "code":
            exec(compile(cell.source, f"{name}.ipynb, cell {number}", "exec"), names)


def test_the_cluster_example_is_one_run(bits):
    """Dask on a local cluster gives the same bytes as one run."""
    distributed = pytest.importorskip("distributed")
    import dask.array as da

    counts = bits.reshape(11, 7, 64, 64).sum(axis=1).astype(np.uint16)
    stack = np.concatenate([counts] * 6)[:64]
    given = {"sensor": "swissspad2", "bits": 3, "ppp": 7.0, "exposure": 0.4, "method": "qbp", "mask": "none"}
    chunks = da.from_array(stack, chunks=(32, -1, -1))
    restored = chunks.map_overlap(
        lambda chunk: qs.restore(chunk, **given).frames,
        depth=(16, 0, 0),
        boundary="none",
        dtype=np.float32,
        meta=np.empty((0, 0, 0), np.float32),
    )
    cluster = distributed.LocalCluster(n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None)
    with cluster, distributed.Client(cluster):
        frames = restored.compute()
    assert np.array_equal(frames, qs.restore(stack, **given).frames)


def test_parts_are_one_run(counts):
    options = {"sensor": "qudi-paper", "ppp": 9.75, "method": "qbp"}
    stack = np.concatenate([counts] * 2)
    whole = qs.restore(stack, **options)
    parts = [qs.restore(stack, shard=f"{n}/3", **options).frames for n in (1, 2, 3)]
    assert np.array_equal(np.concatenate(parts), whole.frames)


def _has(name):
    try:
        __import__(name)
    except ImportError:
        return False
    return True
