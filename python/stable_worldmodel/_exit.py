"""The end of the interpreter.

Python before 3.14 unwinds the stacks of threads that still run when the interpreter has ended, which aborts the process
in the middle of the engine. So the engine's calls end before, and other threads cannot load the engine afterwards.
"""

from __future__ import annotations

import atexit
import os
import sys
from _thread import get_ident

__all__ = ["check_thread"]

_process = os.getpid()
#: The thread that ends the interpreter.
_ended_by: int | None = None


def check_thread() -> bool:
    """Whether this thread ends the interpreter. Ends the thread silently if another one does."""
    if _ended_by not in (None, get_ident()):
        raise SystemExit
    return _ended_by is not None


@atexit.register
def _end() -> None:
    """Waits for the engine's calls in other threads, and for an import of the engine."""
    global _ended_by
    # A forked process has no other threads, but perhaps their locks.
    if os.getpid() != _process:
        return
    _ended_by = get_ident()
    if f"{__package__}._engine" in sys.modules:
        from . import _engine

        _engine.end_calls()
