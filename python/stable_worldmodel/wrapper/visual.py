"""Wrappers that change pictures: perturbations for worlds whose insides cannot be varied, and beside factors of variation.

    world = swm.World("ALE/Pong-v5", num_envs=8, extra_wrappers=[
        partial(NoiseWrapper, std=8.0),
        partial(ColorJitterWrapper, brightness=0.3, hue=0.1),
    ])

In a `World` they run in the engine. Around a Gymnasium environment they change `render()` and the `pixels` of its infos. What
is drawn at random follows from the episode's seed, so an episode looks the same whenever it is played. `swm wrappers`
lists their settings and what they may be.
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
    """A number that changes with the steps of an episode."""

    def __init__(self, kind: str, *numbers: float) -> None:
        self.kind, self.numbers = kind, tuple(float(number) for number in numbers)

    def __call__(self, step: int) -> float:
        """The number at a step."""
        return _engine.schedule(json.dumps(self.setting()), int(step))

    def setting(self) -> Any:
        """It as a setting of the engine."""
        return self.numbers[0] if self.kind == "constant" else [self.kind, *self.numbers]

    def __repr__(self) -> str:
        return f"{self.kind}({', '.join(f'{number:g}' for number in self.numbers)})"


def constant(value: float) -> Schedule:
    """Always the same."""
    return Schedule("constant", value)


def linear(start: float, end: float, steps: int) -> Schedule:
    """Straight from `start` to `end` in `steps` steps, then held."""
    return Schedule("linear", start, end, steps)


def cosine(start: float, end: float, steps: int) -> Schedule:
    """Half a cosine from `start` to `end` in `steps` steps, then held."""
    return Schedule("cosine", start, end, steps)


def exponential(start: float, decay: float, floor: float = 0.0) -> Schedule:
    """`start`, times `decay` every step, never below `floor`."""
    return Schedule("exponential", start, decay, floor)


def sinusoidal(low: float, high: float, period: int) -> Schedule:
    """A sine between `low` and `high`, from their middle upwards, `period` steps long."""
    return Schedule("sinusoidal", low, high, period)


class VisualWrapper(gymnasium.Wrapper):
    """Something done to pictures, by the engine.

    Args:
        env: A Gymnasium environment.
        seed: What it draws where a reset names no seed.
        **settings: Its settings.
    """

    #: Its id in the engine.
    id: ClassVar[str]
    #: The names of its settings, in the order in which they may be given without them.
    positional: ClassVar[tuple[str, ...]] = ()

    def __init__(self, env: gymnasium.Env, *values: Any, seed: int | None = None, **settings: Any) -> None:
        super().__init__(env)
        self._settings = self.engine_settings(*values, **settings)
        self._engine_wrapper = _engine.VisualWrappers(json.dumps([[self.id, self._settings]]))
        self._seed, self._episode, self._step = seed or 0, 0, 0
        self._engine_wrapper.reset(self._seed)

    @classmethod
    def engine_settings(cls, *values: Any, seed: int | None = None, **settings: Any) -> dict[str, Any]:
        """Settings as the engine takes them."""
        if len(values) > len(cls.positional):
            raise TypeError(f"{cls.__name__} takes {', '.join(cls.positional) or 'nothing'}, got {len(values)} values")
        settings = {**dict(zip(cls.positional, values, strict=False)), **settings}
        return {name: _plain(cls, name, value) for name, value in settings.items() if value is not None}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begins an episode: what is drawn once for all its pictures is drawn."""
        self._episode += 1
        self._step = 0
        self._engine_wrapper.reset(self._seed + self._episode if seed is None else seed)
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, self._changed(info)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Steps, and changes the pictures among the infos."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._step += 1
        return observation, reward, terminated, truncated, self._changed(info)

    def render(self) -> Any:
        """The picture, changed."""
        picture: Any = self.env.render()
        return picture if picture is None else self.apply(picture)

    def apply(self, picture: np.ndarray) -> np.ndarray:
        """A changed copy of a picture, `[height, width, 3]` bytes."""
        picture = np.asarray(picture)
        if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
            name = type(self).__name__
            raise ValueError(f"{name}: expected a picture [height, width, 3] of uint8, got {picture.dtype} {picture.shape}")
        return self._engine_wrapper.apply(np.ascontiguousarray(picture), self._step)

    def _changed(self, info: dict[str, Any]) -> dict[str, Any]:
        for name in [name for name in info if name == "pixels" or name.startswith("pixels.")]:
            info[name] = self.apply(info[name])
        return info


def _plain(cls: type, name: str, value: Any) -> Any:
    if isinstance(value, Schedule):
        return value.setting()
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, (tuple, list)):
        plain = [_plain(cls, name, inner) for inner in value]
        # Several colours are one list of their numbers.
        return [n for inner in plain for n in inner] if plain and isinstance(plain[0], list) else plain
    if callable(value):
        return _tabulated(cls, name, value)
    return value


#: The steps of an episode for which a function of one's own is asked; its last number is held.
_STEPS = 10_000


def _tabulated(cls: type, name: str, schedule: Callable[[int], Any]) -> list[float]:
    """The numbers that a function gives for the steps of an episode: the engine asks for no Python."""
    try:
        numbers = [float(schedule(step)) for step in range(_STEPS)]
    except (TypeError, ValueError) as error:
        raise TypeError(f"{cls.__name__}: {name} is no function from a step of the episode to a number: {error}") from error
    while len(numbers) > 1 and numbers[-1] == numbers[-2]:
        numbers.pop()
    return numbers


class ChromaKeyWrapper(VisualWrapper):
    """Replaces colours by a picture or a video."""

    id = "chroma-key"
    positional = ("key_color", "media", "tolerance")


class NoiseWrapper(VisualWrapper):
    """Adds Gaussian noise of a standard deviation `std`, or salt and pepper (`kind`, `amount`)."""

    id = "noise"
    positional = ("std",)


class ColorJitterWrapper(VisualWrapper):
    """Changes brightness, contrast, saturation and hue, by the same amounts for an episode."""

    id = "color-jitter"
    positional = ("brightness", "contrast", "saturation", "hue")


class BlurWrapper(VisualWrapper):
    """Blurs with a Gaussian window."""

    id = "blur"
    positional = ("kernel", "sigma")


class OcclusionWrapper(VisualWrapper):
    """Lays rectangles over the picture, at the same places for an episode."""

    id = "occlusion"
    positional = ("num_patches", "size", "color")


class MovingPatchWrapper(VisualWrapper):
    """Lays rectangles over the picture that drift and bounce off its edges."""

    id = "moving-patch"
    positional = ("num_patches", "size", "color", "speed")


class RandomShiftWrapper(VisualWrapper):
    """Shifts the picture by a few pixels."""

    id = "random-shift"
    positional = ("pad",)


class CutoutWrapper(VisualWrapper):
    """Masks rectangles, elsewhere in every picture."""

    id = "cutout"
    positional = ("num", "size", "color")


class RandomConvWrapper(VisualWrapper):
    """Passes the picture through a random convolution, the same for an episode."""

    id = "random-conv"
    positional = ("kernel_size",)


class GrayscaleWrapper(VisualWrapper):
    """Removes colour and keeps brightness, in three equal channels."""

    id = "grayscale"

    @classmethod
    def engine_settings(cls, *values: Any, seed: int | None = None, **settings: Any) -> dict[str, Any]:
        keep_channels = settings.pop("keep_channels", values[0] if values else True)
        if not keep_channels:
            raise ValueError("GrayscaleWrapper: pictures keep three channels here; take one of them")
        return super().engine_settings(seed=seed, **settings)


class ResolutionWrapper(VisualWrapper):
    """Draws the picture with fewer, larger pixels."""

    id = "resolution"
    positional = ("scale",)


def engine_wrappers(factories: Sequence[Callable[..., Any]]) -> list[tuple[str, dict[str, Any]]] | None:
    """What factories of wrappers make, for the engine; `None` where one of them is of another kind."""
    known = []
    for factory in factories:
        values: tuple[Any, ...] = ()
        settings: dict[str, Any] = {}
        while isinstance(factory, functools.partial):
            values, settings = factory.args + values, {**factory.keywords, **settings}
            factory = factory.func
        if not (isinstance(factory, type) and issubclass(factory, VisualWrapper)):
            return None
        known.append((factory.id, factory.engine_settings(*values, **settings)))
    return known
