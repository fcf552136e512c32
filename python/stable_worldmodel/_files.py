"""Replaces files as a whole, so that a full disk or a kill keeps the old ones."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path


def replace(files: Mapping[Path, Callable[[Path], object]]) -> None:
    """Writes files, each by a function of the path to write to: beside its place, which it takes once all are written.

    What a kill leaves beside a file is replaced when the file is written again.
    """
    beside = {path: path.with_name(f".{path.name}.tmp") for path in files}
    try:
        for path, write in files.items():
            # A link is not written through.
            beside[path].unlink(missing_ok=True)
            write(beside[path])
        for path, written in beside.items():
            os.replace(written, path)
    except BaseException:
        for written in beside.values():
            written.unlink(missing_ok=True)
        raise
