"""Versions, for bug reports."""

from __future__ import annotations

import platform
import sys
from importlib import metadata

from . import _native

__version__ = _native.version().split("\n", 1)[0]


def show_versions() -> None:
    """Prints the versions of this package, of Python and of the packages that it works with."""
    lines = _native.version().splitlines()
    print(f"qudi_spad  {lines[0]}")
    for line in lines[1:]:
        print(line)
    print(f"python     {sys.version.split()[0]} on {platform.platform()}")
    for name in ("numpy", "napari", "dask", "tqdm", "torch"):
        try:
            print(f"{name:<10} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            continue
