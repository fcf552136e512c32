"""`ReacherDMControlWrapper`."""

from __future__ import annotations

from typing import Any

import numpy as np

from .dmcontrol import DMControlWrapper

__all__ = ["ReacherDMControlWrapper"]


class ReacherDMControlWrapper(DMControlWrapper):
    """Reacher of the DeepMind Control suite: `swm/ReacherDMControl-v0`."""

    id = "swm/ReacherDMControl-v0"

    def __init__(
        self, task: str = "hard", seed: int | None = None, environment_kwargs: Any = None, render_mode: str | None = None
    ) -> None:
        super().__init__(task, seed, environment_kwargs, render_mode)
        self._task = task

    def set_target_qpos(self, target_qpos: Any) -> None:
        """Sets the goal of the task `qpos_match`: the positions `(2,)` of the joints.

        Raises:
            ValueError: If the environment has another task, or the positions have another size.
        """
        if self._task != "qpos_match":
            raise ValueError(f"set_target_qpos: the task is {self._task!r}; choose task='qpos_match'")
        target = np.asarray(target_qpos, np.float64)
        if target.shape != (2,):
            raise ValueError(f"set_target_qpos: the shape {target.shape}; expected (2,)")
        self._change(goal=np.concatenate([target, np.zeros(2)]))

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode. The option `target_qpos` is the goal of the task `qpos_match`."""
        given = dict(options or {})
        target = given.pop("target_qpos", None)
        found = super().reset(seed, given)
        if target is None:
            return found
        self.set_target_qpos(target)
        return self._get_obs(), self._get_info()
