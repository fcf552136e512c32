"""A platform for reproducible world-model research: worlds, datasets, models, planners and evaluation.

    import stable_worldmodel as swm

    world = swm.World("swm/PushT-v1", num_envs=8)
    world.set_policy(swm.policy.RandomPolicy(seed=42))
    world.collect("pusht.lance", episodes=100, seed=42)

Importing this package is cheap: its parts, numpy and the engine are loaded when they are first used. torch is
never imported before something of torch's is used. Environments register themselves with Gymnasium.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from . import _registration

if TYPE_CHECKING:
    from . import data, envs, planning, policy, solver, spaces, utils, wm, wrapper
    from .policy import PlanConfig
    from .world import Metrics, World

__all__ = [
    "Metrics",
    "PlanConfig",
    "World",
    "data",
    "envs",
    "planning",
    "policy",
    "solver",
    "spaces",
    "utils",
    "wm",
    "wrapper",
]

#: Where what is not a module of its own comes from.
_HOMES = {"World": "world", "Metrics": "world", "PlanConfig": "policy"}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from ._engine import __version__

        return __version__
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        home = importlib.import_module(f"{__name__}.{_HOMES.get(name, name)}")
    except ImportError as error:
        if "libav" in str(error) or "libsw" in str(error):
            message = (
                f"{error}\nThis wheel uses the FFmpeg libraries of the machine it was built on, and they are not here. "
                "Install those, or a wheel that has them inside (make wheel-portable)."
            )
            raise ImportError(message) from error
        raise
    value = getattr(home, name) if name in _HOMES else home
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__, "__version__"])


_registration.install()
