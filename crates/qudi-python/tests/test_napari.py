"""The plugin, in a real napari without a screen."""

import os
import subprocess
import sys
import time
import warnings

import numpy as np
import pytest

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
try:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import napari
        import npe2
        from qtpy.QtWidgets import QApplication
except ImportError as error:
    pytest.skip(f"no napari with widgets: {error}", allow_module_level=True)

import qudi_spad as qs  # noqa: E402

MANIFEST = os.path.join(os.path.dirname(qs.__file__), "napari.yaml")
pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.fixture(scope="module")
def plugins():
    manager = npe2.PluginManager.instance()
    manager.register(npe2.PluginManifest.from_file(MANIFEST))
    return manager


@pytest.fixture
def viewer():
    application = QApplication.instance() or QApplication([])
    viewer = napari.components.ViewerModel()
    yield viewer
    viewer.layers.clear()
    application.processEvents()


def wait_until(condition, seconds=60):
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        QApplication.instance().processEvents()
        time.sleep(0.01)
    assert condition()


def test_the_manifest_is_complete(plugins):
    manifest = plugins.get_manifest("qudi-spad")
    for command in manifest.contributions.commands:
        assert callable(plugins.commands.get(command.id)), command.id


def test_captures_are_read_after_a_look_inside(plugins, npy, counts, tmp_path):
    layers = npe2.read([str(npy)], stack=False)
    assert np.array_equal(np.asarray(layers[0][0]), counts)
    from qudi_spad._napari import reader

    np.save(tmp_path / "angles.npy", np.zeros(5))
    (tmp_path / "notes.bin").write_bytes(b"no capture at all")
    assert reader(str(tmp_path / "angles.npy")) is None
    assert reader(str(tmp_path / "notes.bin")) is None
    assert reader(str(tmp_path)) is None
    (tmp_path / "frames").mkdir()
    qs.write(tmp_path / "frames" / "capture", counts)
    assert reader(str(tmp_path / "frames" / "capture")) is not None


def test_lazy_captures_are_layers(viewer, npy, counts):
    layer = viewer.add_image(qs.open(npy), contrast_limits=(0, 7))
    viewer.dims.set_current_step(0, 4)
    assert layer.data.shape == counts.shape
    assert np.array_equal(np.asarray(layer.data[4]), counts[4])


def test_recorded_captures_tell_light_and_sensor(plugins, viewer, tmp_path):
    run = [sys.executable, "-m", "qudi_spad", "simulate", "scene:text", "--size=64x64", "-oburst.npy"]
    environment = {**os.environ, "PYTHONPATH": os.path.dirname(os.path.dirname(qs.__file__))}
    subprocess.run(run, cwd=tmp_path, env=environment, check=True, capture_output=True)
    ((data, options, _),) = npe2.read([str(tmp_path / "burst.npy")], stack=False)
    viewer.add_image(data, **options)
    widget = plugins.commands.get("qudi-spad.restore")(viewer)
    widget._layer.choices = list(viewer.layers)
    widget._method.value = "mle"
    assert widget.keywords() == {"method": "mle"}
    widget._clicked()
    wait_until(lambda: widget._worker is None)
    assert viewer.layers["burst restored"].data.shape == (11, 64, 64)


def test_samples_are_restored_by_the_widget(plugins, viewer):
    for data, options, _ in plugins.commands.get("qudi-spad.simulate")():
        viewer.add_image(data, **options)
    widget = plugins.commands.get("qudi-spad.restore")(viewer)
    widget._layer.choices = list(viewer.layers)
    widget._layer.value = viewer.layers["counts"]
    widget._method.value = "qbp"
    assert widget.keywords() == {"method": "qbp", "sensor": "qudi-paper", "ppp": pytest.approx(9.75, rel=0.2)}
    widget._clicked()
    wait_until(lambda: widget._worker is None)
    restored = viewer.layers["counts restored"].data
    assert restored.shape == (11, 128, 128)
    assert qs.metrics.psnr_aligned(restored, viewer.layers["truth"].data).mean() > 18
    widget._ppp.value = "bright"
    with pytest.raises(ValueError):
        widget.keywords()


def test_the_button_stops(plugins, viewer, counts):
    viewer.add_image(np.concatenate([counts] * 100), name="long")
    widget = plugins.commands.get("qudi-spad.restore")(viewer)
    widget._layer.choices = list(viewer.layers)
    widget._layer.value = viewer.layers["long"]
    widget._method.value, widget._sensor.value, widget._ppp.value = "qbp-refined", "qudi-paper", "9.75"
    widget._clicked()
    wait_until(lambda: widget._bar.value > 0)
    widget._clicked()
    wait_until(lambda: widget._worker is None)
    assert "long restored" not in viewer.layers
