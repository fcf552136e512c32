"""Gymnasium environments in this interpreter, for `World`."""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from . import _engine
from ._forks import fork_lock
from .wrapper.visual import VisualWrapper, engine_wrappers


def _forget_bridge() -> None:
    """Makes a forked process load the modules again that another thread was loading: their code has run in part."""
    for name, last in (("swm_bridge", "make"), ("swm_craftax", "Craftax")):
        if not hasattr(sys.modules.get(name), last):
            sys.modules.pop(name, None)


#: Only one thread loads the module of the bridge: Python lists a module before its code has run.
_LOADING = fork_lock(_forget_bridge)


def open_world(
    env_name: str,
    options: Mapping[str, Any],
    num_envs: int,
    wrappers: Sequence[Callable[..., Any]],
    image: tuple[int, int] | None,
    max_episode_steps: int | None,
    nearest: bool | None,
    threads: int,
    wrap_goal: bool,
) -> tuple[Any, list[Any], list[Any], str | None]:
    """Creates a world of Gymnasium environments.

    If all wrappers are visual wrappers of this package, they run in the engine. Otherwise all wrappers run in Python.
    `nearest` is the interpolation that resizes frames: see `is_nearest`.

    Returns:
        The engine's world, the list of its Gymnasium environments (the world appends each one that it creates), the ids and
        settings of the wrappers that run in the engine, and the interpolation if it is not that of the environment.
    """
    in_engine = engine_wrappers(wrappers)
    in_python = [] if in_engine is not None else list(wrappers)
    try:
        with _LOADING:
            bridge = _engine.bridge(env_name.startswith("swm/Craftax"))
    except ModuleNotFoundError as error:
        raise _missing("craftax", error) from error
    envs: list[Any] = []
    #: The entries of `info` that all environments share, so that only one warns of those without a column.
    known: set[str] = set()
    resampled: set[str] = set()
    # Native environments render at any size, so their frames need no resizing.
    sized = {"image_shape": image} if image is not None and env_name in _engine.envs() else {}

    def make() -> Any:
        try:
            made = bridge.make(env_name, {**options, **sized}, in_python)
        except bridge.Missing as error:
            raise _missing(error.args[0], error) from error
        known.update(made.known)
        made.known = known
        if max_episode_steps is not None:
            made.max_episode_steps = max_episode_steps
        if nearest is not None:
            if image is not None and not sized and nearest != bool(getattr(made.env.unwrapped, "swm_pixel_art", False)):
                resampled.add("nearest" if nearest else "bilinear")
            made.env.unwrapped.swm_pixel_art = nearest
        envs.append(made.env)
        if wrap_goal and in_python and any(isinstance(layer, VisualWrapper) for layer in _layers(made.env)):
            made.env.close()
            raise ValueError(
                "wrap_goal: visual wrappers change the frame of the goal only in the engine, and other wrappers of this world "
                "are written in Python, which makes all of them run in Python; leave those out, or use wrap_goal=False"
            )
        return made

    described = ",".join([env_name, *(f"{key}={value}" for key, value in options.items())])
    world = _engine.World.gymnasium(
        described, make, num_envs, image, max_episode_steps, threads, json.dumps(in_engine or []), wrap_goal
    )
    if running := [type(layer).__name__ for layer in _layers(envs[0]) if _keeps_statistics(layer)]:
        warnings.warn(
            f"{env_name}: statistics of {', '.join(running)} carry over from episode to episode, so that episodes depend on "
            "those before them and on num_envs; set update_running_mean of the wrappers to False where they must not",
            stacklevel=3,
        )
    return world, envs, in_engine or [], next(iter(resampled), None)


def _layers(env: Any) -> Iterator[Any]:
    """An environment with its wrappers, from the outermost to the innermost."""
    while env is not None:
        yield env
        env = getattr(env, "env", None)


def _keeps_statistics(layer: Any) -> bool:
    """Whether a wrapper normalizes by statistics that it updates in every step, as `NormalizeObservation` of Gymnasium does."""
    # Some wrappers return attributes of the environment inside as their own.
    has_own = hasattr(type(layer), "update_running_mean") or "update_running_mean" in getattr(layer, "__dict__", ())
    return has_own and bool(layer.update_running_mean)


def is_nearest(resample: Any) -> bool | None:
    """Whether frames are resized by the nearest pixel (else bilinearly); `None` if nothing is given.

    Raises:
        ValueError: When it is the name or the number in Pillow of another interpolation.
    """
    if resample is None:
        return None
    name = str(getattr(resample, "name", resample)).lower()
    # The numbers are those of Pillow's filters.
    if name not in ("nearest", "0", "bilinear", "2"):
        raise ValueError(f"image_resample: {resample!r}; expected 'bilinear' or 'nearest', or None for that of the environment")
    return name in ("nearest", "0")


def _missing(package: str, error: Exception) -> ModuleNotFoundError:
    return ModuleNotFoundError(f"{error.args[-1]}; install it with: pip install 'stable-worldmodel-rs[{package}]'")
