"""Where this interpreter has the package of all capsules, `stable-worldmodel-rs-zoo`. The engine asks when it is loaded."""

from __future__ import annotations

import os
import sys
from importlib.machinery import PathFinder

#: The package, which contains capsules and no code.
_PACKAGE = "stable_worldmodel_zoo"


def data_wheel() -> str | None:
    """Returns the folder of the package, or None where it is not installed.

    It is searched as an import searches it, because systems may keep packages without compiled code in another folder than
    those with it (`lib` and `lib64`). The current folder is left out, so that no name of the zoo means a file of a stranger.
    """
    spec = PathFinder.find_spec(_PACKAGE, [path for path in sys.path if not _is_current_folder(path)])
    # A folder of this name without `__init__.py` is not the package.
    return os.path.dirname(spec.origin) if spec and spec.origin else None


def _is_current_folder(path: str) -> bool:
    try:
        return not path or os.path.samefile(path, os.curdir)
    except OSError:
        return False
