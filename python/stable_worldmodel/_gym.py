"""Gymnasium environments in a `World`, in this interpreter or in processes of their own."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from . import _engine
from .wrapper.visual import engine_wrappers


def open_world(
    env_name: str,
    options: Mapping[str, Any],
    num_envs: int,
    wrappers: Sequence[Callable[..., Any]],
    image: tuple[int, int] | None,
    max_episode_steps: int | None,
    resample: Any,
    threads: int,
    wrap_goal: bool,
) -> tuple[Any, list[Any], list[Any]]:
    """The engine's world of environments that Gymnasium makes, the environments, and what the engine puts around them.

    Visual wrappers of ours run in the engine; with any other among them, all of them run where Gymnasium puts them.
    """
    drawn = engine_wrappers(wrappers)
    inside = [] if drawn is not None else list(wrappers)
    try:
        bridge = _engine.bridge(env_name.startswith("swm/Craftax"))
    except ModuleNotFoundError as error:
        raise _missing("craftax", error) from error
    envs: list[Any] = []
    # Ours draw in any size, which beats resizing.
    sized = {"image_shape": image} if image is not None and env_name in _engine.envs() else {}

    def make() -> Any:
        try:
            made = bridge.make(env_name, {**options, **sized}, inside)
        except bridge.Missing as error:
            raise _missing(error.args[0], error) from error
        if max_episode_steps is not None:
            made.max_episode_steps = max_episode_steps
        if resample is not None:
            made.env.unwrapped.pixel_art = str(resample).lower() in ("nearest", "0")
        envs.append(made.env)
        return made

    described = ",".join([env_name, *(f"{key}={value}" for key, value in options.items())])
    world = _engine.World.gymnasium(
        described, make, num_envs, image, max_episode_steps, threads, json.dumps(drawn or []), wrap_goal
    )
    return world, envs, drawn or []


def _missing(package: str, error: Exception) -> ModuleNotFoundError:
    return ModuleNotFoundError(f"{error.args[-1]}; install it with: pip install 'stable-worldmodel-rs[{package}]'")
