"""Registers the native environments with Gymnasium: at once if Gymnasium is imported, else right after its import.

After `import stable_worldmodel`, `gymnasium.make("swm/PushT-v1")` works for any order of the two imports.
`stable_worldmodel` does not import Gymnasium at that time.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any


def install() -> None:
    """Registers the environments, or installs an import hook that registers them."""
    if "gymnasium" in sys.modules:
        register()
    elif not any(isinstance(finder, _AfterGymnasium) for finder in sys.meta_path):
        sys.meta_path.insert(0, _AfterGymnasium())


def register() -> None:
    """Registers the native environments with Gymnasium. Further calls change nothing."""
    import gymnasium

    from . import _engine

    # The entry point is a string, because this may run while `stable_worldmodel.envs` itself is being imported.
    for name in _engine.envs():
        if name not in gymnasium.registry:
            gymnasium.register(id=name, entry_point="stable_worldmodel.envs:NativeEnv", kwargs={"name": name})


class _AfterGymnasium:
    """An import finder that registers the environments after the import of `gymnasium`."""

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
