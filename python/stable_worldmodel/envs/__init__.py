"""Our environments as Gymnasium environments.

`gymnasium.make("swm/PushT-v1")` makes one; options of an environment are keyword arguments
(`gymnasium.make("swm/OGBCube-v0", env_type="double")`). Factors of variation, a start and a goal are options of
`reset`: `env.reset(seed=0, options={"variation": ["agent.color"], "variation_values": {"block.scale": 40}})`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import gymnasium
import numpy as np

from .. import _engine, _options
from .. import spaces as swm_spaces
from .._registration import register

__all__ = ["NativeEnv", "experts", "ids", "register"]


def ids() -> list[str]:
    """The ids of our environments."""
    return list(_engine.envs())


def experts(env: str) -> list[str]:
    """Who can demonstrate an environment."""
    return list(_engine.Actor.experts(env))


class NativeEnv(gymnasium.Env):
    """One of our environments.

    Args:
        name: Its id.
        render_mode: `"rgb_array"` or none.
        image_shape: `(height, width)` of pictures.
        **options: What is chosen when it is made, such as `env_type="double"`.

    Observations are what the environment's `observation_space` says; everything it shows is in the infos, with
    `success` (whether the goal is reached) and `goal_distance`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 15}

    def __init__(
        self, name: str, render_mode: str | None = None, image_shape: tuple[int, int] = (224, 224), **options: Any
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode: expected 'rgb_array' or None, got {render_mode!r}")
        #: Its id with its options.
        self.name = ",".join([name, *(f"{key}={value}" for key, value in options.items())])
        self._env = _engine.NativeEnv(self.name, "[]", False)
        self._described: dict[str, Any] = json.loads(self._env.spec())
        self.render_mode = render_mode
        self.image_shape = (int(image_shape[0]), int(image_shape[1]))
        self.action_space = swm_spaces.from_description(self._described["action_space"])
        self.observation_space = swm_spaces.from_description(self._described["observation_space"])
        shown = self._env.reset(0, _options.reset(None, {}))
        self._start = shown["state"]
        if isinstance(self.observation_space, gymnasium.spaces.Dict) and not self.observation_space.spaces:
            # Worlds that leave it open are observed through their state.
            state = shown["state"]
            self.observation_space = gymnasium.spaces.Dict(
                {"state": gymnasium.spaces.Box(-np.inf, np.inf, state.shape, state.dtype)}
            )

    def __getstate__(self) -> dict[str, Any]:
        """What a copy needs to go on from here."""
        return {**self.__dict__, "_env": self.snapshot()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._env = _engine.NativeEnv(self.name, "[]", False)
        self._env.restore(state["_env"])

    @property
    def max_episode_steps(self) -> int:
        """Steps after which an episode is usually truncated (`swm.World` does; `gymnasium.make(…, max_episode_steps=…)`)."""
        return int(self._described["max_episode_steps"])

    @cached_property
    def _variation_space(self) -> swm_spaces.Dict:
        return swm_spaces.variation_space(self._described["variation"], self._described["sampling_order"])

    @property
    def variation_space(self) -> swm_spaces.Dict:
        """The factors of variation, with the values of this episode."""
        space = self._variation_space
        for key, value in self._env.factors().items():
            factor = space.find(key)
            factor._value = np.asarray(value).reshape(factor.shape or ()).astype(factor.dtype)
            if isinstance(factor, swm_spaces.Discrete):
                factor._value = int(factor._value)
        return space

    def reset(self, *, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode: factors, start and goal follow from the seed alone."""
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(2**62))
        shown = self._env.reset(seed, _options.reset(options, self._described["variation"]))
        self._start = shown["state"]
        return self._observed(shown), self._info(shown, self._env.is_success())

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Applies an action."""
        continuous = isinstance(self.action_space, gymnasium.spaces.Box)
        action = np.ascontiguousarray(action, dtype=np.float32 if continuous else np.int64).reshape(-1)
        shown, reward, terminated, truncated, success = self._env.step(action)
        return self._observed(shown), reward, terminated, truncated, self._info(shown, success)

    def render(self) -> np.ndarray | None:
        """The picture, `[height, width, 3]` bytes."""
        return self._env.render(*self.image_shape, False) if self.render_mode == "rgb_array" else None

    def render_goal(self) -> np.ndarray:
        """The picture of the goal, `[height, width, 3]` bytes."""
        return self._env.render(*self.image_shape, True)

    def render_view(self, view: str) -> np.ndarray:
        """What a view shows: a camera, `depth`, `segmentation`, or `CAMERA:MODALITY`."""
        return self._env.render_view(view, *self.image_shape)

    def sample_goal(self, seed: int) -> None:
        """Chooses a new reachable goal, without moving the world."""
        self._env.sample_goal(seed)

    def goal_distance(self) -> float:
        """How far the world is from its goal."""
        return self._env.goal_distance()

    def snapshot(self) -> bytes:
        """The full state, randomness included."""
        return self._env.snapshot()

    def restore(self, state: bytes) -> tuple[Any, dict[str, Any]]:
        """Puts a state back; what follows equals what followed the snapshot."""
        shown = self._env.restore(state)
        return self._observed(shown), self._info(shown, self._env.is_success())

    def restore_from(self, start: Mapping[str, Any], goal: Mapping[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Continues from a row of a dataset towards the state of another."""
        rows = ({key: np.asarray(value)[None] for key, value in row.items()} for row in (start, goal))
        shown = self._env.restore_from(*rows)
        return self._observed(shown), self._info(shown, self._env.is_success())

    # What an evaluation from a dataset calls where environments of ours live in Gymnasium's wrappers.

    def _set_state(self, state: Any) -> None:
        self._start = np.asarray(state)
        self._set_goal_state(state)

    def _set_goal_state(self, goal_state: Any) -> None:
        self.restore_from({"state": self._start}, {"state": np.asarray(goal_state)})

    def _observed(self, shown: Mapping[str, np.ndarray]) -> Any:
        space = self.observation_space
        if isinstance(space, gymnasium.spaces.Dict):
            return {key: shown[key].astype(inner.dtype, copy=False) for key, inner in space.spaces.items()}
        name = self._described.get("observation_column", "state")
        return shown[name].astype(space.dtype, copy=False)

    def _info(self, shown: dict[str, Any], success: bool) -> dict[str, Any]:
        shown["success"] = success
        shown["goal_distance"] = self._env.goal_distance()
        return shown
