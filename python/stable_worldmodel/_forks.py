"""Locks that a forked process can take."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from typing import Any
from weakref import WeakKeyDictionary

__all__ = ["fork_lock"]

#: The locks, with what a forked process calls if another thread held the lock.
_locks: WeakKeyDictionary[Any, Callable[[], None] | None] = WeakKeyDictionary()


def fork_lock(interrupted: Callable[[], None] | None = None) -> Any:
    """A reentrant lock that is free in a forked process, unless the thread that forks holds it.

    A forked process does not have the other threads, so a lock that one of them held would never be released there. What that
    thread was changing may be half changed.

    Args:
        interrupted: Called in a forked process if another thread held the lock. It is kept as long as the lock.
    """
    lock = threading.RLock()
    _locks[lock] = interrupted
    return lock


def _free_locks() -> None:
    """Frees the locks of threads that this process does not have."""
    for lock, interrupted in list(_locks.items()):
        if lock.acquire(blocking=False):
            lock.release()
            continue
        lock._at_fork_reinit()
        if interrupted is not None:
            interrupted()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_free_locks)
