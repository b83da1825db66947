"""The whole program: ``qudi`` and ``python -m qudi_spad``."""

import sys

from . import _native


def main() -> int:
    """Runs the program with the arguments of this process, and returns its exit code."""
    return _native.main(["qudi", *sys.argv[1:]])


if __name__ == "__main__":
    sys.exit(main())
