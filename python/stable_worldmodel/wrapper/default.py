"""Wrappers that put everything about a step into the infos, and check it.

    env = MegaWrapper(gymnasium.make("CartPole-v1", render_mode="rgb_array"), image_shape=(64, 64))
    _, info = env.reset(seed=0)
    info["pixels"], info["observation"], info["reward"], info["step_idx"]

`World` fills the infos itself; these wrappers are for environments that your own code steps.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import gymnasium
import numpy as np

from ..utils import get_in

__all__ = [
    "AddPixelsWrapper",
    "EnsureGoalInfoWrapper",
    "EnsureImageShape",
    "EnsureInfoKeysWrapper",
    "EverythingToInfoWrapper",
    "MapKeysWrapper",
    "MegaWrapper",
    "ResizeGoalWrapper",
]


class CollisionError(ValueError, AssertionError):
    """The infos of an environment have a key that a wrapper adds."""


class _InfoWrapper(gymnasium.Wrapper):
    """Base class of wrappers that read or change the infos of resets and steps."""

    def reset(self, *args: Any, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Resets the environment."""
        observation, info = self.env.reset(*args, **kwargs)
        return observation, self._changed(info, "reset()")

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Steps the environment."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, self._changed(info, "step()")

    def _changed(self, info: dict[str, Any], where: str) -> dict[str, Any]:
        """The infos, checked or changed; `where` is the method that returned them."""
        raise NotImplementedError


class EnsureInfoKeysWrapper(_InfoWrapper):
    """Raises `RuntimeError` if the infos lack a key.

    Args:
        env: The environment.
        required_keys: Regular expressions; a key must match each of them completely.
    """

    def __init__(self, env: gymnasium.Env, required_keys: Iterable[str]) -> None:
        super().__init__(env)
        self._patterns = [re.compile(key) for key in required_keys]

    def _changed(self, info: dict[str, Any], where: str) -> dict[str, Any]:
        missing = [pattern.pattern for pattern in self._patterns if not any(map(pattern.fullmatch, info))]
        if missing:
            raise RuntimeError(f"{where}: no info key matches {missing}; the keys are {sorted(info)}")
        return info


class EnsureImageShape(_InfoWrapper):
    """Raises `RuntimeError` if an image in the infos has another size.

    Args:
        env: The environment.
        image_key: The key of the image.
        image_shape: `(height, width)`.
    """

    def __init__(self, env: gymnasium.Env, image_key: str, image_shape: tuple[int, int]) -> None:
        super().__init__(env)
        self.image_key, self.image_shape = image_key, image_shape

    def _changed(self, info: dict[str, Any], where: str) -> dict[str, Any]:
        shape = tuple(info[self.image_key].shape)
        if shape[:-1] != tuple(self.image_shape):
            raise RuntimeError(f"{where}: {self.image_key!r} has shape {shape}, expected {(*self.image_shape, 3)}")
        return info


class EnsureGoalInfoWrapper(_InfoWrapper):
    """Raises `RuntimeError` if the infos lack `goal`.

    Args:
        env: The environment.
        check_reset: Whether resets are checked.
        check_step: Whether steps are checked.
    """

    def __init__(self, env: gymnasium.Env, check_reset: bool, check_step: bool = False) -> None:
        super().__init__(env)
        self.check_reset, self.check_step = check_reset, check_step

    def _changed(self, info: dict[str, Any], where: str) -> dict[str, Any]:
        checked = self.check_reset if where == "reset()" else self.check_step
        if checked and "goal" not in info:
            raise RuntimeError(f"{where}: the infos have no 'goal'; the keys are {sorted(info)}")
        return info


class EverythingToInfoWrapper(gymnasium.Wrapper):
    """Adds observation, reward, ends of episodes, action, step and factors of variation to the infos.

    The keys: those of a dict observation, else `observation`; `reward`, `terminated`, `truncated`, `action` (NaN after a
    reset, -1 for integers), `step_idx` (steps since the reset), `id` (random for each episode), and `variation.KEY` for the
    factors that the reset's `options["variation"]` names.
    """

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        self._factors: list[str] = []
        self._step, self._id = 0, 0

    def reset(self, *args: Any, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Resets the environment."""
        observation, info = self.env.reset(*args, **kwargs)
        options = kwargs.get("options") or {}
        if "variation" in options:
            self._factors = self._named(options["variation"])
        self._step = 0
        random: Any = self.env.unwrapped.np_random
        draw = random.integers if hasattr(random, "integers") else random.randint
        self._id = int(draw(0, np.iinfo(np.int64).max))
        action = np.asarray(self.env.action_space.sample())
        missing = np.full_like(action, np.nan if action.dtype.kind == "f" else -1)
        return observation, self._filled(info, observation, np.nan, False, False, missing)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Steps the environment."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._step += 1
        info = self._filled(info, observation, reward, bool(terminated), bool(truncated), action)
        return observation, reward, terminated, truncated, info

    def _named(self, variation: Any) -> list[str]:
        """The dot keys of the factors that a reset samples."""
        if isinstance(variation, str) or not isinstance(variation, Iterable):
            raise CollisionError(f"options['variation']: expected a list of factors, got {variation!r}")
        names = list(variation)
        return list(self.env.unwrapped.variation_space.names()) if names == ["all"] else names  # type: ignore[attr-defined]

    def _filled(
        self, info: dict[str, Any], observation: Any, reward: Any, terminated: bool, truncated: bool, action: Any
    ) -> dict[str, Any]:
        added = dict(observation) if isinstance(observation, Mapping) else {"observation": observation}
        added |= {"reward": reward, "terminated": terminated, "truncated": truncated, "action": action}
        added |= {"step_idx": self._step, "id": self._id}
        for key in self._factors:
            space = get_in(self.env.unwrapped.variation_space, key.split("."))  # type: ignore[attr-defined]
            added[f"variation.{key}"] = space.value
        observed = set(observation) if isinstance(observation, Mapping) else {"observation"}
        for key in added.keys() & info.keys():
            # Native environments have the values of their observation in the infos as well.
            if key not in observed or not _equal(info[key], added[key]):
                raise CollisionError(f"the infos of {self.env} have the key {key!r} already; rename it with MapKeysWrapper")
        info.update(added)
        return info


def _equal(one: Any, other: Any) -> bool:
    try:
        return np.array_equal(np.asarray(one), np.asarray(other), equal_nan=True)
    except TypeError:
        return False


class MapKeysWrapper(_InfoWrapper):
    """Renames keys of the infos.

    Args:
        env: The environment.
        key_map: The new names by the present ones. A missing key raises `KeyError`.
    """

    def __init__(self, env: gymnasium.Env, key_map: Mapping[str, str]) -> None:
        super().__init__(env)
        self.key_map = dict(key_map)

    def _changed(self, info: dict[str, Any], where: str) -> dict[str, Any]:
        for present, new in self.key_map.items():
            if present not in info:
                raise KeyError(f"{where}: the infos have no {present!r} to rename; the keys are {sorted(info)}")
            info[new] = info.pop(present)
        return info


class _Resizing:
    """Resizes frames, and applies a user's function to them.

    Args:
        shape: `(height, width)`.
        function: A function of a `PIL.Image`; `None` gives arrays `(height, width, 3)`.
        resample: The filter of Pillow; bilinear for `None`.
    """

    def __init__(self, shape: tuple[int, int], function: Callable[[Any], Any] | None, resample: Any) -> None:
        self.shape, self.function, self.resample = (int(shape[0]), int(shape[1])), function, resample

    def __call__(self, frame: Any) -> Any:
        frame = np.asarray(frame)
        if frame.shape[:2] == self.shape and self.function is None:
            return frame
        try:
            from PIL import Image
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(f"{error}; resizing frames needs Pillow: pip install pillow") from error

        resample = _filter(self.resample)
        image = Image.fromarray(frame).resize(self.shape[::-1], Image.Resampling.BILINEAR if resample is None else resample)
        return np.array(image) if self.function is None else self.function(image)


def _filter(resample: Any) -> Any:
    """The filter of Pillow with this name; other values unchanged."""
    if not isinstance(resample, str):
        return resample
    from PIL import Image

    names = ("nearest", "bilinear", "bicubic", "lanczos", "box", "hamming")
    if resample.lower() not in names:
        raise ValueError(f"image_resample: {resample!r}; expected one of {', '.join(names)}")
    return getattr(Image, resample.upper())


class _FrameWrapper(_InfoWrapper):
    """Changes frames in the infos.

    Args:
        env: The environment.
        pixels_shape: `(height, width)` of the frame.
        torchvision_transform: A function of the resized frame, a `PIL.Image`.
        resample: The filter of Pillow that resizes frames; bilinear for `None`.
    """

    def __init__(
        self,
        env: gymnasium.Env,
        pixels_shape: tuple[int, int] = (84, 84),
        torchvision_transform: Callable[[Any], Any] | None = None,
        resample: Any = None,
    ) -> None:
        super().__init__(env)
        self.pixels_shape = pixels_shape
        self._resized = _Resizing(pixels_shape, torchvision_transform, resample)


class AddPixelsWrapper(_FrameWrapper):
    """Adds the rendered frame as `pixels`, and the seconds that it took as `render_time`.

    An environment with `render_multiview`, or that renders several frames, gives `pixels.NAME` for each of them.

    The environment needs the render mode `rgb_array`.
    """

    def _changed(self, info: dict[str, Any], where: str) -> dict[str, Any]:
        render = getattr(self.env.unwrapped, "render_multiview", None)
        begun = time.perf_counter()
        frame = render() if callable(render) else self.env.render()
        seconds = time.perf_counter() - begun
        if isinstance(frame, (list, tuple)):
            frame = dict(enumerate(frame))
        frames = {f"pixels.{name}": view for name, view in frame.items()} if isinstance(frame, dict) else {"pixels": frame}
        if frames.get("pixels", 0) is None:
            raise ValueError(f"{self.env} renders nothing; create it with render_mode='rgb_array'")
        info.update((key, self._resized(view)) for key, view in frames.items())
        info["render_time"] = seconds
        return info


class ResizeGoalWrapper(_FrameWrapper):
    """Resizes the frame `goal` in the infos, if they have one."""

    def _changed(self, info: dict[str, Any], where: str) -> dict[str, Any]:
        if "goal" in info:
            info["goal"] = self._resized(info["goal"])
        return info


class MegaWrapper(gymnasium.Wrapper):
    """All infos that policies and datasets need: frames, everything about the step, and a check of the keys.

    Args:
        env: The environment, with the render mode `rgb_array` if `add_pixels`.
        image_shape: `(height, width)` of frames.
        pixels_transform: A function of the resized frame, a `PIL.Image`.
        goal_transform: The same for the frame of the goal.
        required_keys: Regular expressions that keys of the infos must match.
        separate_goal: Has no effect: the frame of the goal is resized if the infos have one.
        image_resample: The filter of Pillow that resizes frames, or its name: `"bilinear"`, `"nearest"`, …
        add_pixels: Whether frames are rendered.
    """

    def __init__(
        self,
        env: gymnasium.Env,
        image_shape: tuple[int, int] = (84, 84),
        pixels_transform: Callable[[Any], Any] | None = None,
        goal_transform: Callable[[Any], Any] | None = None,
        required_keys: Iterable[str] | None = None,
        separate_goal: bool = True,
        image_resample: Any = None,
        add_pixels: bool = True,
    ) -> None:
        required = list(required_keys or ())
        resample = _filter(image_resample)
        if add_pixels:
            required.append(r"pixels(\..*)?")
            env = AddPixelsWrapper(env, image_shape, pixels_transform, resample)
        env = EnsureInfoKeysWrapper(EverythingToInfoWrapper(env), required)
        if add_pixels:
            env = ResizeGoalWrapper(env, image_shape, goal_transform, resample)
        super().__init__(env)
