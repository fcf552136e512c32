"""Gymnasium environments in this interpreter, for `World`."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from . import _engine
from .wrapper.visual import engine_wrappers

#: Only one thread loads the module of the bridge: Python lists a module before its code has run.
_LOADING = threading.RLock()


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
    """Creates a world of Gymnasium environments.

    If all wrappers are visual wrappers of this package, they run in the engine. Otherwise all wrappers run in Python.

    Returns:
        The engine's world, the list of its Gymnasium environments (the world appends each one that it creates), and the
        ids and settings of the wrappers that run in the engine.
    """
    in_engine = engine_wrappers(wrappers)
    in_python = [] if in_engine is not None else list(wrappers)
    try:
        with _LOADING:
            bridge = _engine.bridge(env_name.startswith("swm/Craftax"))
    except ModuleNotFoundError as error:
        raise _missing("craftax", error) from error
    envs: list[Any] = []
    # Native environments render at any size, so their frames need no resizing.
    sized = {"image_shape": image} if image is not None and env_name in _engine.envs() else {}

    def make() -> Any:
        try:
            made = bridge.make(env_name, {**options, **sized}, in_python)
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
        described, make, num_envs, image, max_episode_steps, threads, json.dumps(in_engine or []), wrap_goal
    )
    return world, envs, in_engine or []


def _missing(package: str, error: Exception) -> ModuleNotFoundError:
    return ModuleNotFoundError(f"{error.args[-1]}; install it with: pip install 'stable-worldmodel-rs[{package}]'")
