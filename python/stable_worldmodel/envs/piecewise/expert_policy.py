"""`ExpertPolicy` of Piecewise."""

from __future__ import annotations

from typing import Any

from ..named import ScriptedExpert

__all__ = ["ExpertPolicy"]


class ExpertPolicy(ScriptedExpert):
    """Goes to the goal.

    Args:
        action_noise, seed: As for `stable_worldmodel.envs.named.ScriptedExpert`.
        action_repeat_prob: Must be 0.
    """

    def __init__(
        self, action_noise: float = 0.0, action_repeat_prob: float = 0.0, seed: int | None = None, **kwargs: Any
    ) -> None:
        self._refuse(action_repeat_prob=(action_repeat_prob, 0.0))
        super().__init__(action_noise, seed, **kwargs)
