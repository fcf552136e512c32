"""The command line: `swm`, and `python -m stable_worldmodel`."""

from __future__ import annotations

import os
import sys


def main() -> None:
    """Runs the `swm` command with the arguments of this process and exits with its code."""
    from . import _engine

    # `--on ray` runs in this interpreter.
    os.environ.setdefault("SWM_RAY_PYTHON", sys.executable)
    sys.exit(_engine.command(["swm", *sys.argv[1:]]))


if __name__ == "__main__":
    main()
