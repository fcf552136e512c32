"""The command line: `swm`, and `python -m stable_worldmodel`."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

#: What tells `swm convert` of the Python package from that of the engine, which takes the target and `--format`.
_CONVERT_OPTIONS = ("--dest-format", "--source-format", "-f")


def main() -> None:
    """Runs the `swm` command with the arguments of this process and exits with its code.

    It takes two spellings of the Python package stable-worldmodel as well: `swm fovs PushT-v1`, and
    `swm convert NAME [OUTPUT] --dest-format FORMAT`.
    """
    from . import _engine

    arguments = sys.argv[1:]
    # `--on ray` runs in this interpreter; environments, trackers and exports do unless the user names another one.
    os.environ.setdefault("SWM_RAY_PYTHON", sys.executable)
    os.environ["SWM_OWN_PYTHON"] = sys.executable
    if arguments[:1] == ["convert"] and any(argument.partition("=")[0] in _CONVERT_OPTIONS for argument in arguments):
        sys.exit(_convert(arguments[1:]))
    if arguments[:1] == ["fovs"]:
        arguments = [f"swm/{name}" if f"swm/{name}" in _engine.envs() else name for name in arguments]
    sys.exit(_engine.command(["swm", *arguments]))


def _convert(arguments: Sequence[str]) -> int:
    """Writes a dataset in another format, and returns the exit code."""
    import argparse

    parser = argparse.ArgumentParser("swm convert", description="Write a dataset in another format")
    parser.add_argument("name", help="The dataset: a path or a name")
    parser.add_argument("output", nargs="?", help="The target (default: the dataset's name with _FORMAT)")
    parser.add_argument("-f", "--dest-format", default="video", help="The format to write (default: video)")
    parser.add_argument("--source-format", help="The format to read (default: detected)")
    given = parser.parse_args(arguments)
    from .cli import convert

    try:
        convert(given.name, given.output, given.dest_format, given.source_format)
    except (OSError, RuntimeError, ValueError) as error:
        sys.stderr.write(f"error: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    main()
