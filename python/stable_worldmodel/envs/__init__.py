"""The native environments as Gymnasium environments.

`gymnasium.make("swm/PushT-v1")` creates an environment; options of an environment are keyword arguments
(`gymnasium.make("swm/OGBCube-v0", env_type="double")`). Factors of variation, a start and a goal are options of
`reset`: `env.reset(seed=0, options={"variation": ["agent.color"], "variation_values": {"block.scale": 40}})`.

The modules of this package have a class for each environment, and its experts as policies:

    from stable_worldmodel.envs.two_room import ExpertPolicy, TwoRoomEnv
"""

from __future__ import annotations

from typing import Any

from .. import _engine, _registration
from .native import NativeEnv

__all__ = ["NativeEnv", "experts", "ids", "register"]


def ids() -> list[str]:
    """The ids of the native environments."""
    return list(_engine.envs())


def experts(env: str) -> list[str]:
    """The names of the experts of an environment."""
    return list(_engine.Actor.experts(env))


def register(id: str | None = None, entry_point: Any = None, discrete: bool = False, **kwargs: Any) -> None:
    """Registers an environment with Gymnasium; without arguments, the native environments.

    Args:
        id: The id.
        entry_point: The class, or `MODULE:NAME`.
        discrete: Whether its actions are discrete; for the reader.
        **kwargs: Further arguments of `gymnasium.register`.
    """
    if id is None:
        _registration.register()
        return
    import gymnasium

    gymnasium.register(id=id, entry_point=entry_point, **kwargs)
