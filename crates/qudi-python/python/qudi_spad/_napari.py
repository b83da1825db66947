"""The napari plugin: a reader, sample data, and a widget that restores a layer."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Generator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from magicgui.widgets import ComboBox, Container, LineEdit, ProgressBar, PushButton, create_widget

import qudi_spad as qs

if TYPE_CHECKING:
    import napari  # type: ignore[import-untyped, unused-ignore]

LayerData = tuple[Any, dict[str, Any], str]


def reader(path: str | list[str]) -> Callable[[str], list[LayerData]] | None:
    """Returns the reader of a capture, or None for what is none; the file is looked into, its name is not enough."""
    try:
        qs.open(path if isinstance(path, str) else path[0])
    except (ValueError, OSError):
        return None
    return read


def read(path: str | list[str]) -> list[LayerData]:
    """Opens captures as image layers, whose frames are read when they are shown."""
    return [_layer(one) for one in ([path] if isinstance(path, str) else path)]


def _layer(path: str) -> LayerData:
    capture = qs.open(path)
    first = capture[0]
    bright = max(float(first.max()), 1.0)
    metadata = {"qudi_spad": capture.info()}
    return capture, {"name": Path(path).stem, "contrast_limits": (0.0, bright), "metadata": metadata}, "image"


def simulated() -> list[LayerData]:
    """Returns a simulated burst, and what the camera looked at."""
    with tempfile.TemporaryDirectory() as folder:
        truth = Path(folder, "truth.npy")
        counts, record = qs.simulate("scene:dead-leaves", ppp=9.75, frames=11, size=(128, 128), truth=truth)
        scene = np.load(truth)
    sensor = {"qudi_spad": {"sensor": record["simulation"]["sensor"], "ppp": record["light"]["ppp"]}}
    return [
        (scene, {"name": "truth", "visible": False}, "image"),
        (counts, {"name": "counts", "metadata": sensor}, "image"),
    ]


class RestoreWidget(Container):  # type: ignore[type-arg]
    """Restores the chosen layer on a thread; the button stops it, too."""

    def __init__(self, viewer: napari.viewer.Viewer) -> None:
        self._viewer = viewer
        self._worker: Any = None
        self._layer: Any = create_widget(label="Counts", annotation="napari.layers.Image")
        self._method = ComboBox(label="Method", choices=["default", *qs.methods()])
        self._sensor = ComboBox(label="Sensor", choices=["recorded", *qs.Sensor.presets()])
        self._ppp = LineEdit(label="PPP", value="", tooltip="photons per pixel and frame; empty: recorded or measured")
        self._button = PushButton(text="Restore")
        self._bar = ProgressBar(value=0, min=0, max=1, visible=False)
        super().__init__(
            widgets=[self._layer, self._method, self._sensor, self._ppp, self._button, self._bar]
        )
        self._button.changed.connect(self._clicked)

    def keywords(self) -> dict[str, Any]:
        """Returns the keyword arguments of `restore` that are set here, or recorded in the layer."""
        layer = self._layer.value
        # An open capture knows its record by itself.
        told = layer is None or isinstance(layer.data, qs.Capture)
        recorded = {} if told else layer.metadata.get("qudi_spad", {})
        sensor = recorded.get("sensor")
        options: dict[str, Any] = {
            "method": None if self._method.value == "default" else self._method.value,
            "sensor": sensor["name"] if sensor and self._sensor.value == "recorded" else self._sensor.value,
            "ppp": float(self._ppp.value) if self._ppp.value.strip() else recorded.get("ppp"),
        }
        if options["sensor"] == "recorded":
            options["sensor"] = None
        return {name: value for name, value in options.items() if value is not None}

    def _clicked(self) -> None:
        if self._worker is not None:
            self._worker.quit()
            return
        layer = self._layer.value
        if layer is None:
            self._show_error(ValueError("no layer holds counts: open a capture first"))
            return
        from napari.qt.threading import create_worker  # type: ignore[import-untyped, unused-ignore]

        try:
            options = self.keywords()
        except ValueError as error:
            self._show_error(error)
            return
        self._bar.max = max(int(layer.data.shape[0]), 1)
        self._bar.value, self._bar.visible = 0, True
        self._button.text = "Stop"
        self._worker = create_worker(_restored, layer.data, options, _start_thread=False)
        self._worker.yielded.connect(self._advance)
        self._worker.returned.connect(lambda frames: self._finish(layer.name, frames))
        self._worker.errored.connect(self._show_error)
        self._worker.finished.connect(self._reset)
        self._worker.start()

    def _advance(self, done: int) -> None:
        self._bar.value = min(done, self._bar.max)

    def _finish(self, name: str, frames: npt.NDArray[np.float32] | None) -> None:
        if frames is not None and len(frames):
            self._viewer.add_image(frames, name=f"{name} restored", contrast_limits=(0, 1))

    def _show_error(self, error: BaseException) -> None:
        from napari.utils.notifications import show_error  # type: ignore[import-untyped, unused-ignore]

        show_error(str(error))

    def _reset(self) -> None:
        self._worker = None
        self._button.text = "Restore"
        self._bar.visible = False


def _restored(data: Any, options: dict[str, Any]) -> Generator[int, None, npt.NDArray[np.float32]]:
    frames = []
    for frame in qs.restore_iter(data, **options):
        frames.append(frame)
        yield len(frames)
    return np.stack(frames) if frames else np.empty((0, 0, 0), np.float32)
