"""`TableEnv`: the base class of OGBench's tables, with read-outs of the simulation and changes of the goal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..mujoco import MujocoEnv

__all__ = ["TableEnv"]

#: The origin and the scale of positions in observations.
_CENTRE, _SCALE = np.array([0.425, 0.0, 0.0]), 10.0
#: The index of the first cube's position in `qpos`, after the arm and the gripper; a cube has seven elements.
_FIRST_CUBE = 14
#: The distance within which cubes and openings are at their goal, in metres.
_TOLERANCE = 0.04


class TableEnv(MujocoEnv):
    """A robot arm and objects on a table."""

    def _begin_table(self, multiview: bool, options: Mapping[str, Any]) -> None:
        self._multiview = multiview
        self._has_task = str(options.get("reward_task_id", None)).lower() != "none"

    @property
    def _num_cubes(self) -> int:
        return len(self._columns()["goal/block_yaw"])

    def compute_observation(self) -> Any:
        """The observation of the current state."""
        return self._get_obs()

    def compute_oracle_observation(self) -> np.ndarray:
        """The positions of the cubes `(3 * cubes,)`, centred and scaled as in observations."""
        now = self._columns()
        return np.concatenate([(now[f"privileged/block_{i}_pos"] - _CENTRE) * _SCALE for i in range(self._num_cubes)])

    def compute_reward(self) -> float:
        """The reward of the current state: 1 at the goal, else 0.

        With `reward_task_id`, it is minus the number of objects that are not at their goals.
        """
        if not self._has_task:
            return float(self._env.is_success())
        reached = self._reached(self._columns())
        return float(sum(reached) - len(reached))

    def _reached(self, now: Mapping[str, Any]) -> list[bool]:
        """Whether each object is at its goal."""
        goals = np.reshape(now["goal/block_pos"], (-1, 3))
        distances = [np.linalg.norm(now[f"privileged/block_{i}_pos"] - goal) for i, goal in enumerate(goals)]
        return [bool(distance <= _TOLERANCE) for distance in distances]

    def get_reset_info(self) -> dict[str, Any]:
        """The infos of the current state."""
        return self._get_info()

    def get_step_info(self) -> dict[str, Any]:
        """The infos of the current state."""
        return self._get_info()

    def add_object_info(self, ob_info: dict[str, Any]) -> None:
        """Adds the positions and states of the objects, and their goals."""
        names = ("privileged/", "goal/", "button_states", "prev_button_states")
        ob_info.update({name: value for name, value in self._columns().items() if name.startswith(names)})

    def render(self, camera: str = "front_pixels", *args: Any, **kwargs: Any) -> np.ndarray | None:
        """The frame of a camera, `(height, width, 3)` of `uint8`; `None` without a render mode."""
        if args or kwargs:
            raise TypeError(f"render: unexpected arguments {(*args, *kwargs)}; it takes the name of a camera")
        if self.render_mode is None or camera == self._described["cameras"][0]:
            return super().render()
        return self.render_view(camera)

    def render_multiview(self, camera: str = "front_pixels", *args: Any, **kwargs: Any) -> Any:
        """The frames of `front_pixels` and `side_pixels` by name; without `multiview`, the frame of `camera`."""
        if not self._multiview:
            return self.render(camera, *args, **kwargs)
        return {name: self.render(name, *args, **kwargs) for name in ("front_pixels", "side_pixels")}

    def set_new_target(self, return_info: bool = True, p_stack: float = 0.5) -> Any:
        """Samples another reachable goal of all objects.

        Args:
            return_info: Whether the observation and the infos are returned.
            p_stack: Must be 0.5.
        """
        self._refuse(p_stack=(p_stack, 0.5))
        self.sample_goal(int(self.np_random.integers(2**62)))
        return (self.compute_observation(), self.get_reset_info()) if return_info else None

    def _set_cube_goal(self, cube: int, position: Any, rotation: Any) -> None:
        count = self._num_cubes
        if not 0 <= cube < count:
            raise ValueError(f"cube_id: {cube}; expected an index below {count}")
        values = [np.asarray(position, np.float64)]
        if rotation is not None:
            values.append(np.asarray(rotation, np.float64))
        if [part.shape for part in values] not in ([(3,)], [(3,), (4,)]):
            raise ValueError("target_pos, target_quat: expected the shapes (3,) and (4,)")
        self._set_goal_joints(_FIRST_CUBE + 7 * cube, np.concatenate(values))

    def _set_goal_joints(self, first: int, values: Any) -> None:
        """Replaces elements of `qpos` in the goal state, which begins with the time."""
        goal = self._columns()["goal_state"].copy()
        goal[1 + first : 1 + first + len(values)] = values
        self._change(goal=goal)
