"""Replaces files as a whole, so that a full disk or a kill keeps the old ones."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

#: How long :func:`locked` waits for another process, in seconds.
_MOST_WAIT = 30.0


@contextlib.contextmanager
def locked(folder: Path, *, exclusive: bool) -> Iterator[None]:
    """Keeps writers of a folder's files away, and with `exclusive` readers, too, so that several files are read as they were written.

    The lock is advisory, and that of the engine's writers. File systems without locks keep no one away.

    Raises:
        TimeoutError: If another process holds the lock for half a minute.
    """
    opened = os.open(folder, os.O_RDONLY)
    try:
        end = time.monotonic() + _MOST_WAIT
        while True:
            try:
                fcntl.flock(opened, (fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH) | fcntl.LOCK_NB)
                break
            except OSError as error:
                if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
                    break
                if time.monotonic() > end:
                    raise TimeoutError(f"{folder}: another process writes to it; wait until it has ended") from None
                time.sleep(0.01)
        yield
    finally:
        os.close(opened)


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
