"""Replaces files as a whole, so that a full disk or a kill keeps the old ones."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Mapping
from pathlib import Path


def replace(files: Mapping[Path, Callable[[Path], object]]) -> None:
    """Writes files, each by a function of the path to write to: beside its place, which it takes once all are written.

    A kill leaves `.NAME.NUMBER.tmp`, which the next `swm eval` into this folder deletes if NAME is its own.
    """
    # Other threads and processes may write the same file.
    beside = {path: path.with_name(f".{path.name}.{threading.get_native_id()}.tmp") for path in files}
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
