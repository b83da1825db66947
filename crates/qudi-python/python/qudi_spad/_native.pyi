"""The native module: arguments are flags of the command line, arrays are bytes."""

import os
from collections.abc import Callable, Iterable, Sequence
from typing import Any, final

__all__ = [
    "Capture",
    "FormatError",
    "Lpips",
    "Run",
    "SensorMismatch",
    "Source",
    "compare",
    "main",
    "methods",
    "sensor",
    "sensor_toml",
    "version",
    "write_frames",
]

class FormatError(ValueError): ...
class SensorMismatch(ValueError): ...

@final
class Source:
    @staticmethod
    def array(dtype: str, shape: Sequence[int], fetch: Callable[[int, int], bytes]) -> Source: ...
    @staticmethod
    def stream(next: Callable[[], bytes]) -> Source: ...

@final
class Capture:
    def __new__(cls, arguments: Sequence[str], source: Source | None = None) -> Capture: ...
    def shape(self) -> tuple[int, int, int]: ...
    def info(self) -> str: ...
    def read(self, frame: int) -> bytes: ...

@final
class Run:
    def __new__(
        cls, arguments: Sequence[str], *, frames: bool = False, source: Source | None = None
    ) -> Run: ...
    def next(self) -> tuple[str, Any] | None: ...
    def stop(self, seconds: float) -> bool: ...

@final
class Lpips:
    def __new__(cls, kind: str, folder: str | os.PathLike[str] | None) -> Lpips: ...
    def distance(self, estimate: bytes, truth: bytes, height: int) -> float: ...

def compare(metric: str, estimate: bytes, truth: bytes, height: int) -> float | None: ...
def main(arguments: Sequence[str]) -> int: ...
def methods() -> list[tuple[str, str]]: ...
def sensor(name: str) -> str: ...
def sensor_toml(json: str) -> str: ...
def version() -> str: ...
def write_frames(
    path: str | os.PathLike[str],
    shape: tuple[int, int, int],
    frames: Iterable[bytes],
    *,
    float: bool,
    fps: float,
    force: bool,
) -> None: ...
