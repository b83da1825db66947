"""The interface piece by piece."""

import inspect
import json
import os
import pickle
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import qudi_spad as qs


def test_captures_are_sliced_as_arrays_are(npy, counts):
    capture = qs.open(npy)
    assert capture.shape == counts.shape and capture.ndim == 3 and len(capture) == 11
    assert capture.size == counts.size
    values = counts.astype(capture.dtype)
    for key in [
        0,
        -1,
        slice(2, 5),
        slice(None, None, -3),
        (3, slice(4, 9), 5),
        (slice(1, 4), slice(None), slice(0, 64, 7)),
        (Ellipsis, 3),
        (slice(2, 4), Ellipsis),
        [1, 5, 2],
        np.arange(11) % 2 == 0,
        (),
    ]:
        part = capture[key]
        assert np.array_equal(part, values[key]), key
        assert part.dtype == capture.dtype and part.shape == values[key].shape, key
    with pytest.raises(IndexError, match="frame 11 of 11"):
        capture[11]
    assert np.array_equal(np.asarray(capture), values)
    assert np.array_equal(np.asarray(capture, np.float32), values)
    assert np.array_equal(np.stack(list(capture)), values)
    assert "11 frames of 64 x 64" in repr(capture)
    assert np.array_equal(pickle.loads(pickle.dumps(capture))[3], values[3])


def test_sums_are_captures(bits):
    capture = qs.open(np.packbits(bits, axis=-1), sensor="swissspad2")
    summed = capture.sum(7)
    assert summed.shape == (11, 64, 64)
    assert np.array_equal(summed[2], bits[14:21].sum(axis=0))
    assert summed.sum(11).shape == (1, 64, 64)
    assert summed.info()["max_count"] == 7 and summed.sensor.name == "swissspad2"
    with pytest.raises(ValueError, match="help:"):
        capture.sum(1000)


def test_large_captures_open_at_once(tmp_path):
    path = tmp_path / "large.npy"
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(
            file, {"descr": "|u1", "fortran_order": False, "shape": (24_000, 256, 256)}
        )
        start = file.tell()
        file.truncate(start + 24_000 * 256 * 256)
    times = []
    for _ in range(3):
        begin = time.perf_counter()
        capture = qs.open(path, pack_axis="none")
        times.append(time.perf_counter() - begin)
    # A twentieth of a second on an idle machine.
    assert min(times) < 0.5
    assert capture.shape == (24_000, 256, 256) and capture[23_999].sum() == 0


def test_results_are_documented_by_their_manifest(restored):
    assert restored.frames.dtype == np.float32 and restored.frames.shape == (11, 64, 64)
    assert restored.sigma is None
    assert restored.manifest["settings"]["method"] == "qbp"
    assert 0.5 < restored.manifest["results"]["chi_square"] < 2


def test_the_network_tells_its_uncertainty(counts):
    result = qs.restore(counts, sensor="qudi-paper", ppp=9.75)
    assert result.manifest["settings"]["method"] == "qudi"
    assert result.sigma.shape == result.frames.shape and (result.sigma > 0).all()
    pairs = list(qs.restore_iter(counts, sensor="qudi-paper", ppp=9.75, sigma=True))
    assert np.array_equal(np.stack([frame for frame, _ in pairs]), result.frames)
    assert np.array_equal(np.stack([sigma for _, sigma in pairs]), result.sigma)


def test_progress_is_told(counts, capsys):
    seen = []
    options = {"sensor": "qudi-paper", "ppp": 9.75, "method": "mle"}
    qs.restore(counts, progress=lambda done, total: seen.append((done, total)), **options)
    assert seen == [(n, 11) for n in range(1, 12)]
    qs.restore(counts, progress=True, **options)
    assert "11" in capsys.readouterr().err


def test_an_exception_of_the_progress_stops(counts):
    def stop(done, total):
        raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        qs.restore(counts, sensor="qudi-paper", ppp=9.75, method="mle", progress=stop)


def test_doubts_are_warnings(counts):
    with pytest.warns(qs.CaptureWarning) as caught:
        qs.restore(np.full_like(counts, 7), sensor="qudi-paper", ppp=9.75, method="mle", bits=3)
    assert any("saturated" in str(warning.message) for warning in caught)


def test_streams_pass_their_exceptions_on(counts):
    def camera():
        yield from counts
        raise ConnectionError("unplugged")

    with pytest.raises(ConnectionError, match="unplugged"):
        list(qs.restore_iter(camera(), sensor="qudi-paper", ppp=9.75, method="mle", bits=3))
    with pytest.raises(qs.FormatError, match="no frame"):
        list(qs.restore_iter(iter([]), sensor="qudi-paper"))
    with pytest.raises(qs.FormatError, match="after frames of"):
        list(qs.restore_iter(iter([counts[0], counts[0][:5]]), sensor="qudi-paper", ppp=5.0, bits=3))


def test_sensors(tmp_path):
    sensor = qs.Sensor.preset("swissspad2")
    assert sensor.name == "swissspad2" and sensor.bits == 1
    assert 0 < sensor.quantum_efficiency < 1 and sensor.parameters["response"] == "binary"
    assert "qudi-paper" in qs.Sensor.presets()
    with pytest.raises(ValueError, match="swissspad2"):
        qs.Sensor.preset("swisspad2")
    (tmp_path / "own.toml").write_text('base = "swissspad2"\nname = "own"\ndark = "20/s"\n')
    assert qs.Sensor.from_toml(tmp_path / "own.toml").name == "own"


def test_the_sensor_of_a_capture_is_an_argument(tmp_path):
    """A camera that only a record describes, given on to an array of the same counts."""
    (tmp_path / "own.toml").write_text('base = "swissspad2"\nname = "own"\nquantum_efficiency = 0.31\n')
    own = qs.Sensor.from_toml(tmp_path / "own.toml")
    counts, record = qs.simulate("scene:dead-leaves", sensor=own, ppp=0.4, frames=12, size=(32, 32))
    np.save(tmp_path / "burst.npy", np.packbits(counts, axis=-1))
    (tmp_path / "burst.npy.json").write_text(json.dumps(record))
    (tmp_path / "own.toml").unlink()
    capture = qs.open(tmp_path / "burst.npy")
    assert capture.sensor.name == "own" and "quantum_efficiency = 0.31" in capture.sensor.to_toml()
    given = {"ppp": 0.4, "sum": 1, "method": "mle"}
    expected = qs.restore(capture, **given)
    result = qs.restore(counts, sensor=capture.sensor, bits=1, **given)
    np.testing.assert_array_equal(result.frames, expected.frames)
    other = qs.restore(counts, sensor="swissspad2", bits=1, **given)
    assert not np.array_equal(other.frames, expected.frames)


def test_calibrating(tmp_path):
    rng = np.random.default_rng(2)
    dark = rng.random((2000, 32, 32)) < 0.002
    dark[:, 5, 7] = rng.random(2000) < 0.5
    sensor = qs.calibrate(dark, tmp_path / "camera.toml", sensor="swissspad2")
    assert sensor.name == "camera" and (tmp_path / "camera.dark.npy").exists()
    assert np.load(tmp_path / "camera.bad.npy")[5, 7] != 0
    with pytest.raises(FileExistsError, match="overwrite=True"):
        qs.calibrate(dark, tmp_path / "camera.toml", sensor="swissspad2")
    last = np.moveaxis(dark, 0, -1)
    qs.calibrate(last, tmp_path / "other.toml", sensor="swissspad2", axes="hwt")
    maps = [np.load(tmp_path / f"{name}.dark.npy") for name in ("camera", "other")]
    assert np.array_equal(*maps)


def test_a_look_shows_itself(npy):
    look = qs.look(npy, sensor="qudi-paper", bits=3)
    assert "<html" in look.html and look.info["frames"] == 11
    assert look._repr_html_().startswith("<iframe srcdoc=")


def test_options_of_an_opened_array_apply_once(bits):
    given = {"sum": 7, "start": 7, "sensor": "swissspad2"}
    look = qs.look(qs.open(bits, **given))
    assert look.info["frames"] == len(qs.open(bits, **given)) == 10
    assert qs.look(bits, **given).info["frames"] == 10


def test_writing(tmp_path, counts, bits, restored):
    for name in ["counts.npy", "counts.tif", "counts"]:
        qs.write(tmp_path / name, counts)
        assert np.array_equal(qs.read(tmp_path / name), counts), name
    qs.write(tmp_path / "bits.npy", bits)
    assert np.load(tmp_path / "bits.npy").shape == (77, 64, 8)
    assert np.array_equal(qs.read(tmp_path / "bits.npy"), bits)
    qs.write(tmp_path / "frames.npy", restored.frames)
    assert np.array_equal(np.load(tmp_path / "frames.npy"), restored.frames)
    with pytest.raises(FileExistsError, match="overwrite=True"):
        qs.write(tmp_path / "frames.npy", restored.frames)
    qs.write(tmp_path / "frames.npy", restored.frames[:3], overwrite=True)
    assert len(np.load(tmp_path / "frames.npy")) == 3
    with pytest.raises(ValueError, match="help:"):
        qs.write(tmp_path / "x.npy", counts[0])
    with pytest.raises(ValueError, match="65535"):
        qs.write(tmp_path / "x.npy", counts.astype(int) - 1)


def test_metrics(counts):
    truth = np.random.default_rng(0).random((3, 48, 64)).astype(np.float32)
    estimate = np.clip(truth + 0.05, 0, 1)
    mse = ((estimate - truth) ** 2).mean(axis=(1, 2))
    assert np.allclose(qs.metrics.psnr(estimate, truth), -10 * np.log10(mse), atol=1e-3)
    assert qs.metrics.psnr(truth[0], truth[0]) == 100
    assert (qs.metrics.psnr_aligned(0.5 * truth, truth) > 60).all()
    assert qs.metrics.ssim(truth[0], truth[0]) == pytest.approx(1)
    assert qs.metrics.gmsd(truth[0], truth[0]) == 0
    assert np.isnan(qs.metrics.ssim(truth[0][:3, :3], truth[0][:3, :3]))
    with pytest.raises(ValueError, match="help:"):
        qs.metrics.psnr(truth, truth[0])


def test_lpips_names_its_missing_weights(tmp_path):
    image = np.zeros((64, 64), np.float32)
    with pytest.raises((ValueError, OSError), match="lpips|alex"):
        qs.metrics.lpips(image, image, weights=tmp_path)


def test_training_is_a_loop(tmp_path):
    run = qs.train("tiny", tmp_path / "run", settings={"train.steps": 30})
    for event in run:
        if event["kind"] == "step":
            assert event["step"] == 1 and event["total"] > 0
            break
    assert run.weights.exists()
    # The run was some steps ahead of the loop.
    steps = [event["step"] for event in qs.train(None, tmp_path / "run", resume=True) if event["kind"] == "step"]
    assert 1 < steps[0] < 25 and steps == list(range(steps[0], 31))
    anew = list(qs.train("tiny", tmp_path / "run", settings={"train.steps": 2}, force=True))
    assert [(event["kind"], event["step"]) for event in anew[:2]] == [("validation", 0), ("step", 1)]


def test_versions(capsys):
    qs.show_versions()
    text = capsys.readouterr().out
    assert qs.__version__ in text and "numpy" in text and "kernels" in text


def test_importing_is_quick():
    code = "import time, numpy; t = time.perf_counter(); import qudi_spad; print(time.perf_counter() - t)"
    environment = {**os.environ, "PYTHONPATH": str(Path(qs.__file__).parents[1])}
    run = lambda: subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    run()
    assert min(float(run().stdout) for _ in range(3)) < 0.15


def test_docstrings_and_signatures_are_there():
    for name in qs.__all__:
        item = getattr(qs, name)
        assert name == "__version__" or inspect.getdoc(item), name
        if inspect.isfunction(item):
            kinds = [p.kind for p in inspect.signature(item).parameters.values()]
            assert inspect.Parameter.POSITIONAL_OR_KEYWORD not in kinds, name
    assert json.dumps(qs.open(np.ones((3, 8, 8), bool)).info())


def test_the_laboratory_suite_keeps_its_name(tmp_path):
    """`qudi-core` installs `qudi/core` without `qudi/__init__.py`: a package `qudi` of ours would hide it."""
    (tmp_path / "qudi" / "core").mkdir(parents=True)
    (tmp_path / "qudi" / "core" / "__init__.py").write_text("name = 'suite'\n")
    code = "import qudi_spad, qudi.core; assert qudi.core.name == 'suite' and qudi_spad.methods()"
    paths = [str(Path(qs.__file__).parents[1]), str(tmp_path)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment)


def program(text):
    environment = {**os.environ, "PYTHONPATH": str(Path(qs.__file__).parents[1])}
    code = "import qudi_spad as qs\nimport numpy as np\n" + text
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, timeout=120)
    return run.returncode, run.stdout, run.stderr


def test_programs_end_while_something_is_restored():
    text = """
def camera():
    while True:
        yield np.ones((64, 64), np.uint8)
stream = qs.restore_iter(camera(), sensor="qudi-paper", ppp=3.0, method="qbp", bits=3)
print(next(stream).shape)
"""
    assert program(text) == (0, "(64, 64)\n", "")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_forked_processes_are_told():
    text = """
import os, warnings
warnings.simplefilter("ignore")
counts = np.random.default_rng(0).poisson(2, (5, 16, 16)).clip(0, 7)
qs.restore(counts, sensor="qudi-paper", ppp=3.0, method="mle")
child = os.fork()
if child == 0:
    try:
        qs.restore(counts, sensor="qudi-paper", ppp=3.0, method="mle")
    except RuntimeError as error:
        os._exit(7 if "spawn" in str(error) else 1)
    os._exit(2)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    assert program(text)[:2] == (0, "7\n")
