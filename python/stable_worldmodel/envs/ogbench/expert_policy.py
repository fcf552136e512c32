"""`ExpertPolicy` of OGBench."""

from __future__ import annotations

from typing import Any

from ..named import ScriptedExpert

__all__ = ["ExpertPolicy"]


class ExpertPolicy(ScriptedExpert):
    """The scripted expert of the environment.

    Args:
        policy_type: Must be `markov_oracle`.
        action_noise, seed: As for `stable_worldmodel.envs.named.ScriptedExpert`.
        p_random_action, noise_smoothing, min_norm: Must have their defaults.
    """

    def __init__(
        self,
        policy_type: str = "markov_oracle",
        action_noise: float = 0.1,
        p_random_action: float = 0.0,
        noise_smoothing: float = 0.5,
        min_norm: float = 0.4,
        seed: int | None = None,
        **kwargs: Any,
    ) -> None:
        self._refuse(policy_type=(policy_type, "markov_oracle"), p_random_action=(p_random_action, 0.0))
        self._refuse(noise_smoothing=(noise_smoothing, 0.5), min_norm=(min_norm, 0.4))
        super().__init__(action_noise, seed, **kwargs)
