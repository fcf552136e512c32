"""Checks that wrappers written in Python leave a native environment as its experts know it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .. import _engine, _options

if TYPE_CHECKING:
    from .world import World

__all__ = ["check_experts"]


def check_experts(world: World, policy: Any, *, is_asked: bool) -> None:
    """Checks that the experts of a policy can play the environments of a world, which are in wrappers written in Python.

    An expert reads the columns of the native environment and writes its actions. Any changed column is refused, because
    the engine does not state which columns an expert reads.

    Args:
        world: The world.
        policy: The policy.
        is_asked: Whether a policy of the user asks the expert, and may convert its actions to another space of this shape.

    Raises:
        ValueError: When the wrappers change the action space or a column.
    """
    from ..envs.native import NativeEnv

    name = world.env_name.partition(",")[0]
    if name not in _engine.envs() or not _plays_expert(policy, world.env_name):
        return
    wrapper, native = world.gym_envs[-world.num_envs], None
    while wrapper is not None and native is None:
        native = wrapper if isinstance(wrapper, NativeEnv) else None
        wrapper = getattr(wrapper, "env", None)
    if native is None:
        raise _refused(name, f"hide {name} itself")
    given, own = world.single_action_space, native.action_space
    if given != own and not (is_asked and (given.shape, given.dtype) == (own.shape, own.dtype)):
        raise _refused(name, f"change the action space from {native.action_space} to {world.single_action_space}")
    if world.seed is None:
        # The infos have no episode yet. Whatever plays next begins with a reset.
        world._world.reset([(0, 0)], _options.reset(None, {}))
    changed = [key for key, value in native._columns().items() if not _holds(world.infos.get(key), value)]
    if changed:
        raise _refused(name, f"change or remove the columns {changed}")


def _plays_expert(policy: Any, env_name: str) -> bool:
    from ..policy import ExpertPolicy, MixturePolicy

    if isinstance(policy, MixturePolicy):
        return not {"expert", *_engine.Actor.experts(env_name)}.isdisjoint(policy.weights)
    return isinstance(policy, ExpertPolicy)


def _holds(column: np.ndarray | None, value: Any) -> bool:
    """Whether the infos of the first environment have this value, up to the rounding of single precision."""
    if column is None or column.shape[2:] != np.shape(value):
        return False
    return bool(np.allclose(column[0, 0], value, rtol=1e-5, equal_nan=True))


def _refused(name: str, change: str) -> ValueError:
    return ValueError(
        f"ExpertPolicy: the wrappers of this world {change}; experts of {name} read and act in the environment's own terms. "
        "Play the expert in a World without these wrappers, or write a policy that converts between both"
    )
