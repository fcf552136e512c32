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


def local(what: str, path: str | os.PathLike[str]) -> Path:
    """The path of an output of this machine.

    Raises:
        ValueError: When it is a URI, which would become a folder such as `s3:`.
    """
    scheme, separator, _ = os.fspath(path).partition("://")
    if separator and scheme.isalnum():
        raise ValueError(f"{what}: {os.fspath(path)!r} is a URI; expected a path of this machine")
    return Path(path).expanduser()


@contextlib.contextmanager
def locked(folder: Path, *, exclusive: bool) -> Iterator[None]:
    """Waits for writers of a folder's files, and with `exclusive` for readers, too, so that several files are read as written.

    The lock is advisory, and that of the engine's writers. After half a minute, in a folder that cannot be read, and on file
    systems without locks, the work goes on without it.
    """
    try:
        opened = os.open(folder, os.O_RDONLY)
    except PermissionError:
        yield
        return
    try:
        _wait_for(opened, fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH)
        yield
    finally:
        # A process that was forked meanwhile keeps the lock of a file that is only closed.
        with contextlib.suppress(OSError):
            fcntl.flock(opened, fcntl.LOCK_UN)
        os.close(opened)


def _wait_for(opened: int, lock: int) -> None:
    end = time.monotonic() + _MOST_WAIT
    while time.monotonic() < end:
        try:
            fcntl.flock(opened, lock | fcntl.LOCK_NB)
            return
        except OSError as error:
            if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
                return
        time.sleep(0.01)


def replace(files: Mapping[Path, Callable[[Path], object]]) -> None:
    """Writes files, each by a function of the path to write to: beside its place, which it takes once all are written.

    Who reads several of them under :func:`locked` reads them as they were written.

    A kill leaves `.NAME.NUMBER.tmp`, which the next `swm eval` into this folder deletes if NAME is its own.

    Raises:
        FileExistsError: If one is a folder, a device or a pipe.
    """
    for path in files:
        if path.exists() and not path.is_file():
            raise FileExistsError(f"{path}: not a regular file; choose another name")
    # Other threads and processes may write the same file.
    beside = {path: path.with_name(f".{path.name}.{threading.get_native_id()}.tmp") for path in files}
    try:
        for path, write in files.items():
            # A link is not written through.
            beside[path].unlink(missing_ok=True)
            write(beside[path])
        with contextlib.ExitStack() as locks:
            for folder in sorted({path.parent for path in files} if len(files) > 1 else ()):
                locks.enter_context(locked(folder, exclusive=True))
            for path, written in beside.items():
                os.replace(written, path)
    except BaseException:
        for written in beside.values():
            written.unlink(missing_ok=True)
        raise
