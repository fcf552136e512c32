"""The end of the interpreter.

Python before 3.14 unwinds the stacks of threads that still run when the interpreter has ended, which aborts the process
in the middle of the engine. So the engine's calls end before, and other threads cannot load the engine afterwards.
"""

from __future__ import annotations

import atexit
import importlib
import os
import sys
from _thread import get_ident

__all__ = ["check_thread"]

_ENGINE = f"{__package__}._engine"
#: The process that Python knows, and whether Python forked it.
_process, _is_forked = os.getpid(), False
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
    # A process that C code forked has the locks of threads that it does not have.
    if os.getpid() != _process:
        return
    _ended_by = get_ident()
    if _ENGINE not in sys.modules:
        return
    if not _is_forked:
        importlib.import_module(_ENGINE)
    _call_engine("end_calls")


def _begin_process() -> None:
    """Forgets the threads of the process that this one is forked from."""
    global _process, _is_forked, _ended_by
    _process, _is_forked, _ended_by = os.getpid(), True, None
    _call_engine("forget_calls")


def _call_engine(name: str) -> None:
    """Calls a function of the engine, if the engine is loaded."""
    function = getattr(sys.modules.get(_ENGINE), name, None)
    if function is not None:
        function()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_process)
