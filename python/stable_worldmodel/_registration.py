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
        register()
    elif not any(isinstance(finder, _AfterGymnasium) for finder in sys.meta_path):
        sys.meta_path.insert(0, _AfterGymnasium())


def register() -> None:
    """Registers our environments with Gymnasium; again changes nothing."""
    import gymnasium

    from . import _engine

    # Gymnasium imports the module only when it makes one: this may run in the midst of that module's own import.
    for name in _engine.envs():
        if name not in gymnasium.registry:
            gymnasium.register(id=name, entry_point="stable_worldmodel.envs:NativeEnv", kwargs={"name": name})


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
            register()

        spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec
