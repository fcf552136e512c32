"""Commands that start this interpreter again."""

from __future__ import annotations

import sys

__all__ = ["module_command"]

#: `python -m` puts the current folder first, where a stranger's `json.py` would replace a module of the standard library. The
#: option `-P` leaves it out, but Python 3.10 does not know it.
_PROGRAM = """
import sys
if sys.path[:1] == ['']:
    del sys.path[0]
import runpy
runpy.run_module({name!r}, run_name='__main__', alter_sys=True)
"""


def module_command(name: str, *arguments: str, python: str = sys.executable) -> list[str]:
    """A command that runs a module, as `python -m`, but imports nothing from the current folder.

    Args:
        name: The module.
        *arguments: Its arguments.
        python: The interpreter, by default this one.
    """
    return [python, "-c", _PROGRAM.format(name=name), *arguments]
