"""Captures, restoration and simulation of single-photon cameras.

Arrays are ``[frames, rows, columns]``. Counts are whole numbers, restored frames are float32 in which 1 is full scale.
Every keyword of the command line's ``qudi restore --help`` is one here, with underscores: ``pack_axis="width"`` for
``--pack-axis width``.

>>> import qudi_spad as qs
>>> counts, record = qs.simulate("scene:text", sensor="qudi-paper", frames=3, size=(64, 64))
>>> counts.shape, counts.dtype
((3, 64, 64), dtype('uint8'))
"""

from . import metrics
from ._capture import Capture, open, read
from ._commands import Look, TrainingRun, calibrate, look, methods, train
from ._messages import CaptureWarning
from ._native import FormatError, SensorMismatch
from ._restore import Result, restore, restore_iter
from ._sensor import Sensor
from ._simulate import simulate
from ._versions import __version__, show_versions
from ._write import write

__all__ = [
    "Capture",
    "CaptureWarning",
    "FormatError",
    "Look",
    "Result",
    "Sensor",
    "SensorMismatch",
    "TrainingRun",
    "__version__",
    "calibrate",
    "look",
    "methods",
    "metrics",
    "open",
    "read",
    "restore",
    "restore_iter",
    "show_versions",
    "simulate",
    "train",
    "write",
]
