"""Messages of running commands: warnings, notes in the log, progress, results."""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Iterator
from typing import Any

from . import _native

LOGGER = logging.getLogger("qudi_spad")

# Seconds that an interrupted restoration has for its tile, whose thread then ends by itself.
PATIENCE = 2.0


class CaptureWarning(UserWarning):
    """Something makes the result doubtful; the text says what to do."""


def messages(run: _native.Run, *, patience: float = PATIENCE) -> Iterator[tuple[str, Any]]:
    """Yields the messages of a command but notes and warnings, which are passed on; stops it when it is left."""
    finished = False
    try:
        while (message := run.next()) is not None:
            kind, value = message
            if kind == "note":
                LOGGER.info(value)
            elif kind == "warning":
                warnings.warn(value, CaptureWarning, stacklevel=4)
            else:
                finished = kind == "end"
                yield kind, value
        finished = True
    finally:
        if not finished:
            run.stop(patience)


def result(arguments: list[str]) -> Any:
    """Runs a command to its end and returns the document that ``--json`` prints."""
    document = None
    # It may write files: they are removed before the exception goes on.
    for kind, value in messages(_native.Run(arguments), patience=600.0):
        if kind == "result":
            document = json.loads(value)
    return document
