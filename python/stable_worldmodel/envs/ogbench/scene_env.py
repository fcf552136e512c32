"""`SceneEnv`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from .table import TableEnv

__all__ = ["SceneEnv"]

#: The scales of the drawer and the window in observations.
_DRAWER_SCALE, _WINDOW_SCALE = 18.0, 15.0
#: The indices of the drawer and the window in `qpos`.
_DRAWER, _WINDOW = 23, 24


class SceneEnv(TableEnv):
    """A robot arm and a scene on a table: `swm/OGBScene-v0`.

    Args:
        env_type: Must be `scene`.
        ob_type: `states` or `pixels`.
        permute_blocks: Must be true.
        multiview: Whether `render_multiview` renders two cameras; the factor `camera.angle_delta` turns the first.
        **kwargs: `render_mode`, and options of the environment.
    """

    id = "swm/OGBScene-v0"

    def __init__(
        self,
        env_type: str = "scene",
        ob_type: str = "states",
        permute_blocks: bool = True,
        multiview: bool = False,
        *args: Any,
        **kwargs: Any,
    ) -> None:
        self._refuse(permute_blocks=(permute_blocks, True))
        self._refuse(args=(args, ()))
        render_mode = kwargs.pop("render_mode", "rgb_array")
        self._refuse(env_type=(env_type, "scene"))
        super().__init__(render_mode, options={"ob_type": ob_type, **kwargs})
        self._begin_table(multiview, kwargs)

    def reset(  # type: ignore[override]
        self, options: Mapping[str, Any] | None = None, *, seed: int | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Starts an episode. Factors, start and goal depend only on the seed and the options."""
        return super().reset(seed=seed, options=options)

    def set_state(self, qpos: Any, qvel: Any, **kwargs: Any) -> None:
        """Sets the positions and the velocities of all joints, and the states of the buttons.

        Args:
            qpos, qvel: The positions and the velocities.
            **kwargs: `button_state_0` and `button_state_1`, 0 or 1; the present ones without them.
        """
        buttons = {f"button_state_{index}": index for index in range(2)}
        unknown = [name for name in kwargs if name not in buttons]
        if unknown:
            raise TypeError(f"set_state: unexpected argument {unknown[0]!r}; expected {', '.join(buttons)}")
        states = {buttons[name]: self._button(value) for name, value in kwargs.items()}
        super().set_state(qpos, qvel)
        if states:
            state = self._columns()["state"].copy()
            for index, value in states.items():
                state[self._button_index(index)] = value
            self._change(state=state)

    def compute_oracle_observation(self) -> np.ndarray:
        """The cube, the buttons, the drawer and the window, centred and scaled as in observations."""
        now = self._columns()
        drawer, window = now["privileged/drawer_pos"] * _DRAWER_SCALE, now["privileged/window_pos"] * _WINDOW_SCALE
        return np.concatenate([super().compute_oracle_observation(), now["button_states"].astype(np.float64), drawer, window])

    def set_cube_target_pos(self, cube_id: int, target_pos: Any, target_quat: Any = None) -> None:
        """Sets the goal of the cube; the goal then includes all objects.

        Args:
            cube_id: Must be 0.
            target_pos: Its position `(3,)` in metres.
            target_quat: Its rotation `(4,)`, a quaternion; the goal's present one for `None`.
        """
        self._set_cube_goal(cube_id, target_pos, target_quat)

    def set_target_button_state(self, button_id: int, target_state: int) -> None:
        """Sets the goal of a button, 0 or 1; the goal then includes all objects."""
        if button_id not in (0, 1):
            raise ValueError(f"button_id: {button_id}; expected 0 or 1")
        goal = self._columns()["goal_state"].copy()
        goal[self._button_index(button_id)] = self._button(target_state)
        self._change(goal=goal)

    def set_target_drawer_pos(self, target_pos: float) -> None:
        """Sets the goal of the drawer in metres: 0 is closed, -0.16 open. The goal then includes all objects."""
        self._set_goal_joints(_DRAWER, [target_pos])

    def set_target_window_pos(self, target_pos: float) -> None:
        """Sets the goal of the window in metres: 0 is closed, 0.2 open. The goal then includes all objects."""
        self._set_goal_joints(_WINDOW, [target_pos])

    def _reached(self, now: Mapping[str, Any]) -> list[bool]:
        buttons = [bool(equal) for equal in now["button_states"] == now["goal/button_states"]]
        openings = [abs(now[f"privileged/{name}_pos"][0] - now[f"goal/{name}_pos"][0]) for name in ("drawer", "window")]
        return [*super()._reached(now), *buttons, *(bool(distance <= 0.04) for distance in openings)]

    def _button_index(self, button: int) -> int:
        """The index of a button in a state, which ends with both buttons, the same before the step, `qpos` and `qvel`."""
        now = self._columns()
        return len(now["state"]) - len(now["qpos"]) - len(now["qvel"]) - 4 + button

    @staticmethod
    def _button(value: Any) -> int:
        if value not in (0, 1):
            raise ValueError(f"button state: {value!r}; expected 0 or 1")
        return int(value)
