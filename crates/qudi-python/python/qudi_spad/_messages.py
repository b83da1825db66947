"""Messages of running commands: warnings, notes in the log, progress, results."""

from __future__ import annotations

import json
import logging
import os
import warnings
from collections.abc import Iterator
from typing import Any

from . import _native

LOGGER = logging.getLogger("qudi_spad")

# Seconds that an interrupted restoration has for its tile, whose thread then ends by itself.
PATIENCE = 2.0


# True once threads run, which a forked process does not have; then in that process.
_has_threads = False
_lost_threads = False


def _forked() -> None:
    global _lost_threads
    _lost_threads = _has_threads


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forked)


class CaptureWarning(UserWarning):
    """Something makes the result doubtful; the text says what to do."""


def start(arguments: list[str], *, frames: bool = False, source: _native.Source | None = None) -> _native.Run:
    """Starts a command."""
    global _has_threads
    if _lost_threads:
        raise RuntimeError(
            "this process was forked from one whose threads it needs\n  where: qudi_spad"
            "\n  help: start processes by spawn: multiprocessing.get_context('spawn')"
        )
    _has_threads = True
    return _native.Run(arguments, frames=frames, source=source)


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
    for kind, value in messages(start(arguments), patience=600.0):
        if kind == "result":
            document = json.loads(value)
    return document
