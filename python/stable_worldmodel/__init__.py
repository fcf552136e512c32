"""A platform for reproducible world-model research: environments, datasets, models, planners and evaluation.

    import stable_worldmodel as swm

    world = swm.World("swm/PushT-v1", num_envs=8)
    world.set_policy(swm.policy.RandomPolicy(seed=42))
    world.collect("pusht.lance", episodes=100, seed=42)

Importing this package is cheap: its modules, numpy and the engine are imported on first use, and torch only when a
feature needs it. The environments are registered with Gymnasium.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from . import _exit as _exit
from . import _registration

if TYPE_CHECKING:
    from . import (
        buffer,
        cli,
        data,
        envs,
        planning,
        plot,
        policy,
        protocols,
        solver,
        spaces,
        studies,
        utils,
        wm,
        world,
        wrapper,
    )
    from . import (
        ray as ray,
    )
    from . import (
        train as train,
    )
    from .policy import PlanConfig
    from .world import Metrics, World

__all__ = [
    "Metrics",
    "PlanConfig",
    "World",
    "buffer",
    "cli",
    "data",
    "envs",
    "planning",
    "plot",
    "policy",
    "protocols",
    "solver",
    "spaces",
    "studies",
    "utils",
    "wm",
    "world",
    "wrapper",
]

#: Modules that `import *` leaves out, because they need packages that not everybody has.
_OPTIONAL = ("ray", "train")
#: The modules that define the exported classes.
_MODULES = {"World": "world", "Metrics": "world", "PlanConfig": "policy"}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from ._engine import __version__

        return __version__
    if name not in (*__all__, *_OPTIONAL):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        module = importlib.import_module(f"{__name__}.{_MODULES.get(name, name)}")
    except ImportError as error:
        if "libav" in str(error) or "libsw" in str(error):
            message = (
                f"{error}\nThis wheel needs the FFmpeg libraries of the machine that built it, and they are not installed. "
                "Install them, or use a wheel that contains them (make wheel-portable)."
            )
            raise ImportError(message) from error
        raise
    value = getattr(module, name) if name in _MODULES else module
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__, "__version__"])


_registration.install()
