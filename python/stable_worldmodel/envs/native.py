"""`NativeEnv`: a native environment as a Gymnasium environment."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np

from .. import _engine, _options
from .. import spaces as swm_spaces
from .._lazy import lazy

__all__ = ["NativeEnv"]


class OptionError(TypeError, ValueError):
    """An environment does not have an option."""


class NativeEnv(gymnasium.Env):
    """A native environment.

    Args:
        name: The id of the environment.
        render_mode: `"rgb_array"`, or `None` for no frames.
        image_shape: `(height, width)` of frames.
        **options: Options of the environment, such as `env_type="double"`.

    Observations follow `observation_space`. The infos hold all columns of the environment, and `success` (whether the
    state satisfies the goal) and `goal_distance`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 15}
    #: Tells the bridge that the engine chose the names of the columns, such as `goal/xy`, which it keeps, that seeds may have
    #: 64 bits, and that `_get_info` computes the columns of the current state.
    swm_native = True
    #: A seed of the next reset as wrappers get it, and the seed with 64 bits that it stands for.
    swm_seed: tuple[int, int] | None = None

    def __init__(
        self, name: str, render_mode: str | None = "rgb_array", image_shape: tuple[int, int] = (224, 224), **options: Any
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode: expected 'rgb_array' or None, got {render_mode!r}")
        #: The id with its options.
        self.name = ",".join([name, *(f"{key}={value}" for key, value in options.items())])
        try:
            self._env = _engine.NativeEnv(self.name, "[]", False)
        except ValueError as error:
            unknown = [key for key in options if f"unknown environment option {key!r}" in str(error)]
            if unknown:
                # What Python raises for unknown arguments: TorchRL tries `frameskip`, and goes on without it.
                raise OptionError(f"unexpected keyword argument {unknown[0]!r}: {error}") from error
            raise
        self._described: dict[str, Any] = json.loads(self._env.spec())
        self.render_mode = render_mode
        self.image_shape = (int(image_shape[0]), int(image_shape[1]))
        self.action_space = swm_spaces.from_description(self._described["action_space"])
        self.observation_space = swm_spaces.from_description(self._described["observation_space"])
        #: Whether a program has read `variation_space`, which then gets the values of every episode.
        self._factors_read = False
        columns = self._env.reset(0, _options.reset(None, {}))
        self._start = columns["state"]
        if isinstance(self.observation_space, gymnasium.spaces.Dict) and not self.observation_space.spaces:
            # An environment without an observation space is observed through its state.
            state = columns["state"]
            self.observation_space = gymnasium.spaces.Dict(
                {"state": gymnasium.spaces.Box(-np.inf, np.inf, state.shape, state.dtype)}
            )

    def __getstate__(self) -> dict[str, Any]:
        """The attributes, with the native environment as a snapshot."""
        return {**self.__dict__, "_env": self.snapshot()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._env = _engine.NativeEnv(self.name, "[]", False)
        self._env.restore(state["_env"])

    @property
    def max_episode_steps(self) -> int:
        """Steps after which `swm.World` truncates an episode. In Gymnasium, `make(…, max_episode_steps=…)` sets one."""
        return int(self._described["max_episode_steps"])

    @lazy
    def _variation_space(self) -> swm_spaces.Dict:
        return swm_spaces.variation_space(self._described["variation"], self._described["sampling_order"])

    @property
    def variation_space(self) -> swm_spaces.Dict:
        """The factors of variation, with the values of the current episode until a program sets others."""
        if not self._factors_read:
            self._factors_read = True
            self._fill_factors()
        return self._variation_space

    def _fill_factors(self) -> None:
        """Writes the values of the current episode into `variation_space`, if a program has read it."""
        if not self._factors_read:
            return
        for key, value in self._env.factors().items():
            factor = self._variation_space.find(key)
            factor._value = np.asarray(value).reshape(factor.shape or ()).astype(factor.dtype)
            if isinstance(factor, swm_spaces.Discrete):
                factor._value = int(factor._value)

    def reset(self, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode. Factors, start and goal depend only on the seed and the options."""
        super().reset(seed=seed)
        (folded, whole), self.swm_seed = self.swm_seed or (None, None), None
        if seed is not None and seed == folded:
            seed = whole
        if seed is None:
            seed = int(self.np_random.integers(2**62))
        columns = self._env.reset(seed, _options.reset(options, self._described["variation"]))
        self._fill_factors()
        self._start = columns["state"]
        return self._observation(columns), self._info(columns, self._env.is_success())

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Applies an action.

        Raises:
            ValueError: If it is no action of the space: of another shape, or not finite, real, and whole where the space is.
        """
        dtype = np.float32 if isinstance(self.action_space, gymnasium.spaces.Box) else np.int64
        action = np.asarray(action)
        if action.dtype != dtype:
            action = _as_action(action, dtype)
        columns, reward, terminated, truncated, success = self._env.step(np.ascontiguousarray(action).reshape(-1))
        return self._observation(columns), reward, terminated, truncated, self._info(columns, success)

    def render(self) -> np.ndarray | None:
        """The frame, `(height, width, 3)` of `uint8`; `None` without a render mode."""
        return self._env.render(*self.image_shape, False) if self.render_mode == "rgb_array" else None

    def render_goal(self) -> np.ndarray:
        """The frame of the goal, `(height, width, 3)` of `uint8`."""
        return self._env.render(*self.image_shape, True)

    def render_view(self, view: str) -> np.ndarray:
        """The frame of a camera view: a camera, `depth`, `segmentation`, or `CAMERA:MODALITY`."""
        return self._env.render_view(view, *self.image_shape)

    def sample_goal(self, seed: int) -> None:
        """Samples a new reachable goal and keeps the state."""
        self._env.sample_goal(seed)

    def goal_distance(self) -> float:
        """The distance of the state from the goal, in the environment's units."""
        return self._env.goal_distance()

    def snapshot(self) -> bytes:
        """The full state, including the random state."""
        return self._env.snapshot()

    def restore(self, state: bytes) -> tuple[Any, dict[str, Any]]:
        """Restores a snapshot. Later steps repeat the steps after the snapshot bit for bit."""
        columns = self._env.restore(state)
        self._fill_factors()
        return self._observation(columns), self._info(columns, self._env.is_success())

    def restore_from(self, start: Mapping[str, Any], goal: Mapping[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Restores the state of the dataset row `start`, with the state of the row `goal` as the goal."""
        rows = ({key: np.asarray(value)[None] for key, value in row.items()} for row in (start, goal))
        columns = self._env.restore_from(*rows)
        self._fill_factors()
        return self._observation(columns), self._info(columns, self._env.is_success())

    # Evaluations from a dataset call these methods if Gymnasium wrappers contain the environment.

    def _set_state(self, state: Any) -> None:
        self._start = np.asarray(state)
        self._set_goal_state(self._columns().get("goal_state", state))

    def _set_goal_state(self, goal_state: Any) -> None:
        self.restore_from({"state": self._start}, {"state": np.asarray(goal_state)})

    def _columns(self) -> dict[str, Any]:
        """The columns of the current state."""
        return self._env.restore(self._env.snapshot())

    def _get_obs(self) -> Any:
        return self._observation(self._columns())

    def _get_info(self) -> dict[str, Any]:
        return self._info(self._columns(), self._env.is_success())

    def _observation(self, columns: Mapping[str, np.ndarray]) -> Any:
        space = self.observation_space
        if isinstance(space, gymnasium.spaces.Dict):
            return {key: columns[key].astype(inner.dtype, copy=False) for key, inner in space.spaces.items()}
        name = self._described.get("observation_column", "state")
        return columns[name].astype(space.dtype, copy=False)

    def _info(self, columns: dict[str, Any], success: bool) -> dict[str, Any]:
        columns["success"] = success
        columns["goal_distance"] = self._env.goal_distance()
        return columns


#: The types of objects that are no real numbers, and that numpy would convert to some.
_NOT_REAL = (str, bytes, complex, type(None))


def _as_action(given: np.ndarray, dtype: Any) -> np.ndarray:
    """An action in the type of the space, without what the conversion would lose.

    Raises:
        ValueError: If it has texts, `None`, complex numbers, or fractions where whole numbers are expected.
    """
    kind = given.dtype.kind
    if kind not in "biufO" or (kind == "O" and any(isinstance(value, _NOT_REAL) for value in given.flat)):
        raise ValueError(f"step: expected real actions, got {'complex numbers' if kind == 'c' else given!r}")
    values = given.astype(np.float64) if kind == "O" else given
    if dtype == np.int64 and values.dtype.kind == "f" and not (np.isfinite(values) & (values == np.floor(values))).all():
        raise ValueError(f"step: expected whole numbers, got {given}; choose one of the action space")
    return values.astype(dtype)
