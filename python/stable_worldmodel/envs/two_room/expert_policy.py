"""`ExpertPolicy` of Two-Room."""

from __future__ import annotations

from typing import Any

from ..named import ScriptedExpert

__all__ = ["ExpertPolicy"]


class ExpertPolicy(ScriptedExpert):
    """Goes to the goal, through the nearest door that fits if it is in the other room.

    Args:
        action_noise, seed: As for `stable_worldmodel.envs.named.ScriptedExpert`.
        action_repeat_prob, door_fit_margin, door_reach_tol: Must have their defaults.
    """

    def __init__(
        self,
        action_noise: float = 0.0,
        action_repeat_prob: float = 0.0,
        door_fit_margin: float = 1.1,
        door_reach_tol: float | None = None,
        seed: int | None = None,
        **kwargs: Any,
    ) -> None:
        self._refuse(action_repeat_prob=(action_repeat_prob, 0.0), door_fit_margin=(door_fit_margin, 1.1))
        self._refuse(door_reach_tol=(door_reach_tol, None))
        super().__init__(action_noise, seed, **kwargs)
