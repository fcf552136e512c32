"""Registers our environments with Gymnasium, now if it is loaded, else as soon as it is.

So `import stable_worldmodel` alone makes `gymnasium.make("swm/PushT-v1")` work, in whichever order the two are
imported, and costs nothing for those who do not use Gymnasium.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any


def install() -> None:
    """Registers, or arranges for it."""
    if "gymnasium" in sys.modules:
        _register()
    elif not any(isinstance(finder, _AfterGymnasium) for finder in sys.meta_path):
        sys.meta_path.insert(0, _AfterGymnasium())


def _register() -> None:
    from . import envs

    envs.register()


class _AfterGymnasium:
    """A finder that lets others find `gymnasium`, and registers once it is loaded."""

    def find_spec(self, name: str, path: Any = None, target: ModuleType | None = None) -> Any:
        if name != "gymnasium":
            return None
        sys.meta_path.remove(self)
        import importlib.util

        spec = importlib.util.find_spec(name)
        if spec is None or spec.loader is None:
            return spec
        execute = spec.loader.exec_module

        def exec_module(module: ModuleType) -> None:
            execute(module)
            _register()

        spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec
