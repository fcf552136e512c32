"""`MujocoEnv`: the base class of the environments on MuJoCo, whose state and factors a program may change."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from .named import NamedEnv

__all__ = ["MujocoEnv"]


class MujocoEnv(NamedEnv):
    """A native environment on MuJoCo.

    Factors are those of `variation_space`. A program that changes their values there applies them with
    `apply_runtime_variations`, which keeps the state, or with `compile_model`, which starts an episode.
    """

    def set_state(self, qpos: Any, qvel: Any) -> None:
        """Sets the positions `(nq,)` and the velocities `(nv,)` of all joints. Goal and factors stay as they are.

        Raises:
            ValueError: If they have other sizes, or are not finite.
        """
        now = self._columns()
        parts = []
        for name, given in (("qpos", qpos), ("qvel", qvel)):
            values = np.asarray(given, np.float64)
            if values.shape != now[name].shape:
                raise ValueError(f"set_state: {name} has the shape {values.shape}; {self.id} has {now[name].shape}")
            parts.append(values)
        self._change(state=np.concatenate(parts))

    def apply_runtime_variations(self) -> None:
        """Applies the values of `variation_space` to the simulation, whose state stays as it is.

        Raises:
            ValueError: If a value is not in the space of its factor.
        """
        wanted = self._wanted()
        present = {key: np.asarray(value).reshape(-1) for key, value in self._env.factors().items()}
        changed = {key: value for key, value in wanted.items() if not np.array_equal(np.reshape(value, -1), present[key])}
        if changed:
            self._change(factors=changed)

    def compile_model(self, seed: int | None = None, environment_kwargs: Any = None) -> None:
        """Starts an episode with the values of `variation_space`.

        Args:
            seed: The seed of the episode.
            environment_kwargs: Must be empty: the engine creates the environment.
        """
        self._refuse(environment_kwargs=(environment_kwargs or None, None))
        values = {key: np.asarray(value) for key, value in self._wanted().items()}
        self.reset(seed=seed, options={"variation": [], "variation_values": values})

    def mark_dirty(self) -> None:
        """Has no effect: every reset applies the factors to the model."""

    def _wanted(self) -> dict[str, Any]:
        """The values of `variation_space`, by key."""
        space = self.variation_space
        wanted = {key: space.find(key).value for key in self._described["variation"]}
        wrong = [key for key, value in wanted.items() if not space.find(key).contains(value)]
        if wrong:
            raise ValueError(f"variation_space: {wrong[0]} is {wanted[wrong[0]]}, which is not in {space.find(wrong[0])}")
        return wanted

    def _change(self, state: Any = None, goal: Any = None, factors: Mapping[str, Any] | None = None) -> None:
        """Replaces the state, the goal state or factors, and keeps the rest."""
        now = self._columns()
        start = {"state": now["state"] if state is None else state}
        start.update((f"variation_{key.replace('.', '_')}", value) for key, value in (factors or {}).items())
        self.restore_from(start, {"state": now["goal_state"] if goal is None else goal})
