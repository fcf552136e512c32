"""Visual wrappers: perturbations of frames, for environments with or without factors of variation.

    world = swm.World("ALE/Pong-v5", num_envs=8, extra_wrappers=[
        partial(NoiseWrapper, std=8.0),
        partial(ColorJitterWrapper, brightness=0.3, hue=0.1),
    ])

A `World` runs visual wrappers in the engine. Around a Gymnasium environment, a visual wrapper changes `render()` and the
`pixels` of the infos. Random values depend only on the episode's seed, so frames are reproducible. `swm wrappers` lists the
settings and their ranges.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np

from .. import _engine
from .._overrides import is_overridden

__all__ = [
    "BlurWrapper",
    "ChromaKeyWrapper",
    "ColorJitterWrapper",
    "CutoutWrapper",
    "GrayscaleWrapper",
    "MovingPatchWrapper",
    "NoiseWrapper",
    "OcclusionWrapper",
    "RandomConvWrapper",
    "RandomShiftWrapper",
    "ResolutionWrapper",
    "VisualWrapper",
    "constant",
    "cosine",
    "exponential",
    "linear",
    "sinusoidal",
]


class Schedule:
    """A value that changes with the steps of an episode."""

    def __init__(self, kind: str, *parameters: float) -> None:
        self.kind, self.parameters = kind, tuple(float(parameter) for parameter in parameters)

    def __call__(self, step: int) -> float:
        """The value at a step."""
        return _engine.schedule(json.dumps(self.setting()), int(step))

    def setting(self) -> Any:
        """The schedule as a setting of the engine."""
        return self.parameters[0] if self.kind == "constant" else [self.kind, *self.parameters]

    def __repr__(self) -> str:
        return f"{self.kind}({', '.join(f'{parameter:g}' for parameter in self.parameters)})"


def constant(value: float) -> Schedule:
    """The same value at every step."""
    return Schedule("constant", value)


def linear(start: float, end: float, horizon: int) -> Schedule:
    """Linear from `start` to `end` over `horizon` steps, then constant."""
    return Schedule("linear", start, end, horizon)


def cosine(start: float, end: float, horizon: int) -> Schedule:
    """Half a cosine from `start` to `end` over `horizon` steps, then constant."""
    return Schedule("cosine", start, end, horizon)


def exponential(start: float, decay: float, floor: float = 0.0) -> Schedule:
    """`start * decay**step`, but at least `floor`."""
    return Schedule("exponential", start, decay, floor)


def sinusoidal(low: float, high: float, period: int) -> Schedule:
    """A sine between `low` and `high` with a period of `period` steps, rising from the middle at step 0."""
    return Schedule("sinusoidal", low, high, period)


class VisualWrapper(gymnasium.Wrapper):
    """Base class of visual wrappers, which the engine applies to frames.

    Args:
        env: A Gymnasium environment.
        *values: The settings of `positional`, in order.
        seed: The seed of episodes whose reset has no seed.
        **settings: Settings of the wrapper, as `swm wrappers` lists them.
    """

    #: The id of the wrapper in the engine.
    id: ClassVar[str]
    #: The names of the settings that can be positional arguments, in order.
    positional: ClassVar[tuple[str, ...]] = ()
    #: The index in the stack: the number of visual wrappers inside this one.
    _index = 0

    def __init__(self, env: gymnasium.Env, *values: Any, seed: int | None = None, **settings: Any) -> None:
        super().__init__(env)
        self._settings = self.engine_settings(*values, **settings)
        self._index = _count(env)
        self._engine_wrapper = self._made()
        self._seed, self._episode, self._step = seed or 0, 0, 0
        self._episode_seed = self._seed
        self._engine_wrapper.reset(self._seed)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_engine_wrapper": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._engine_wrapper = self._made()
        self._engine_wrapper.reset(self._episode_seed)

    def _made(self) -> _engine.VisualWrappers:
        """The wrapper in the engine, at its index in the stack, on which its random values depend."""
        below = [["cutout", {"num": 0}]] * self._index
        return _engine.VisualWrappers(json.dumps([*below, [self.id, self._settings]]))

    @classmethod
    def engine_settings(cls, *values: Any, seed: int | None = None, **settings: Any) -> dict[str, Any]:
        """The settings for the engine, with names and plain JSON values."""
        if len(values) > len(cls.positional):
            raise TypeError(f"{cls.__name__} takes {', '.join(cls.positional) or 'nothing'}, got {len(values)} values")
        settings = {**dict(zip(cls.positional, values, strict=False)), **settings}
        return {name: _to_json(cls, name, value) for name, value in settings.items() if value is not None}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode and samples the parameters that are constant during it."""
        self._episode += 1
        self._step = 0
        self._episode_seed = self._seed + self._episode if seed is None else seed
        self._engine_wrapper.reset(self._episode_seed)
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, self._changed(info)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Steps the environment and applies the wrapper to the frames in the infos."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._step += 1
        return observation, reward, terminated, truncated, self._changed(info)

    @property
    def step_count(self) -> int:
        """Steps since the reset."""
        return self._step

    def render(self) -> Any:
        """The changed frame."""
        frame: Any = self.env.render()
        return frame if frame is None else self.apply(frame)

    def apply(self, frame: np.ndarray) -> np.ndarray:
        """A changed copy of a frame `(height, width, 3)` of `uint8`."""
        frame = np.asarray(frame)
        if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
            name = type(self).__name__
            raise ValueError(f"{name}: expected a frame (height, width, 3) of uint8, got {frame.dtype} {frame.shape}")
        return self._engine_wrapper.apply(np.ascontiguousarray(frame), self._step)

    def _changed(self, info: dict[str, Any]) -> dict[str, Any]:
        for name in [name for name in info if name == "pixels" or name.startswith("pixels.")]:
            info[name] = self.apply(info[name])
        return info


def _count(env: Any) -> int:
    """The number of visual wrappers of an environment."""
    count = 0
    while isinstance(env, gymnasium.Wrapper):
        count += isinstance(env, VisualWrapper)
        env = env.env
    return count


def _to_json(cls: type, name: str, value: Any) -> Any:
    if isinstance(value, Schedule):
        return value.setting()
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, (tuple, list)):
        plain = [_to_json(cls, name, inner) for inner in value]
        # Several colours become one flat list of channel values.
        return [n for inner in plain for n in inner] if plain and isinstance(plain[0], list) else plain
    if callable(value):
        return _tabulated(cls, name, value)
    return value


#: The number of steps for which a user's schedule function is tabulated; later steps have the last value.
_STEPS = 10_000


def _tabulated(cls: type, name: str, schedule: Callable[[int], Any]) -> list[float]:
    """The values of a schedule function at the steps of an episode, because the engine does not call Python."""
    try:
        values = [float(schedule(step)) for step in range(_STEPS)]
    except (TypeError, ValueError) as error:
        raise TypeError(f"{cls.__name__}: {name} is no function from a step of the episode to a number: {error}") from error
    while len(values) > 1 and values[-1] == values[-2]:
        values.pop()
    return values


class ChromaKeyWrapper(VisualWrapper):
    """Replaces colours by an image or a video."""

    id = "chroma-key"
    positional = ("key_color", "media", "tolerance")


class NoiseWrapper(VisualWrapper):
    """Adds Gaussian noise of a standard deviation `std`, or salt and pepper (`kind`, `amount`)."""

    id = "noise"
    positional = ("std",)


class ColorJitterWrapper(VisualWrapper):
    """Changes brightness, contrast, saturation and hue by amounts that are constant during an episode."""

    id = "color-jitter"
    positional = ("brightness", "contrast", "saturation", "hue")


class BlurWrapper(VisualWrapper):
    """Blurs with a Gaussian window."""

    id = "blur"
    positional = ("kernel", "sigma")


class OcclusionWrapper(VisualWrapper):
    """Covers parts of the frame with rectangles at positions that are constant during an episode."""

    id = "occlusion"
    positional = ("num_patches", "size", "color")


class MovingPatchWrapper(VisualWrapper):
    """Covers parts of the frame with rectangles that move and bounce off the frame's edges."""

    id = "moving-patch"
    positional = ("num_patches", "size", "color", "speed")


class RandomShiftWrapper(VisualWrapper):
    """Shifts the frame by a few pixels."""

    id = "random-shift"
    positional = ("pad",)


class CutoutWrapper(VisualWrapper):
    """Masks rectangles at new positions in every frame."""

    id = "cutout"
    positional = ("num", "size", "color")


class RandomConvWrapper(VisualWrapper):
    """Applies a random convolution to the frame, constant during an episode."""

    id = "random-conv"
    positional = ("kernel_size",)


class GrayscaleWrapper(VisualWrapper):
    """Removes colour and keeps brightness, in three equal channels."""

    id = "grayscale"

    @classmethod
    def engine_settings(cls, *values: Any, seed: int | None = None, **settings: Any) -> dict[str, Any]:
        keep_channels = settings.pop("keep_channels", values[0] if values else True)
        if not keep_channels:
            raise ValueError(
                "GrayscaleWrapper: keep_channels=False is not supported: frames have three channels; select one of them"
            )
        return super().engine_settings(seed=seed, **settings)


class ResolutionWrapper(VisualWrapper):
    """Reduces the resolution of the frame: fewer, larger pixels."""

    id = "resolution"
    positional = ("scale",)


def engine_wrappers(factories: Sequence[Callable[..., Any]]) -> list[tuple[str, dict[str, Any]]] | None:
    """Ids and settings of visual wrappers made by these factories; `None` if one makes another or is a user's subclass."""
    known = []
    for factory in factories:
        values: tuple[Any, ...] = ()
        settings: dict[str, Any] = {}
        while isinstance(factory, functools.partial):
            values, settings = factory.args + values, {**factory.keywords, **settings}
            factory = factory.func
        if not (isinstance(factory, type) and issubclass(factory, VisualWrapper)):
            return None
        if any(is_overridden(factory, method) for method in ("__init__", "reset", "step", "render", "apply")):
            return None
        known.append((factory.id, factory.engine_settings(*values, **settings)))
    return known
