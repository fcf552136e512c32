"""Costs of models with one latent per observation: a one-step prediction, and objectives on latents.

`LatentDynamics` is what GRASP plans with. `LatentCost` makes a `Costable` of it: it rolls out every candidate and sums the
objectives of the trajectories. Works with numpy and with torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np

__all__ = ["ActionPenalty", "GoalDistance", "LatentCost", "LatentDynamics", "LatentObjective"]


@runtime_checkable
class LatentDynamics(Protocol):
    """A model with a latent state; `latent_dim` is its dimension."""

    def encode(self, info_dict: dict[str, Any]) -> Any:
        """The latents `(B, D)` of the current observation in infos `(B, T, ..)`."""
        ...

    def encode_goal(self, info_dict: dict[str, Any]) -> Any:
        """The latents `(B, D)` of the goal in infos `(B, T, ..)`."""
        ...

    def predict(self, latents: Any, actions: Any) -> Any:
        """The latents `(N, D)` one model step after `latents` `(N, D)`, with `actions` `(N, A)`."""
        ...


class LatentObjective(Protocol):
    """A cost term of trajectories of latents."""

    def __call__(self, latents: Any, goal: Any, actions: Any) -> Any:
        """The costs `(N,)` of latents `(N, H + 1, D)` (the current latent first), goals `(N, D)` and actions `(N, H, A)`."""
        ...


class GoalDistance:
    """The squared distance of the last latent from the goal latent; with `running`, summed over all predicted latents."""

    def __init__(self, weight: float = 1.0, running: bool = False) -> None:
        self.weight, self.running = float(weight), bool(running)

    def __call__(self, latents: Any, goal: Any, actions: Any) -> Any:
        reached = latents[:, 1:] if self.running else latents[:, -1:]
        return self.weight * ((reached - goal[:, None]) ** 2).sum((1, 2))


class ActionPenalty:
    """The squared norm of the actions, in the model's units."""

    def __init__(self, weight: float = 1.0) -> None:
        self.weight = float(weight)

    def __call__(self, latents: Any, goal: Any, actions: Any) -> Any:
        return self.weight * (actions**2).sum((1, 2))


class LatentCost:
    """A `Costable` made of `LatentDynamics`: rolls out every candidate and sums the objectives."""

    def __init__(self, dynamics: LatentDynamics, objective: LatentObjective | Sequence[LatentObjective] | None = None) -> None:
        if not isinstance(dynamics, LatentDynamics):
            raise TypeError(f"{type(dynamics).__name__} is not LatentDynamics: expected encode, encode_goal and predict")
        self.dynamics = dynamics
        #: Whether the model gets tensors, or arrays for `"numpy"`.
        self.backend: str = getattr(dynamics, "backend", "torch")
        objectives = [GoalDistance()] if objective is None else objective
        self.objectives = list(objectives) if isinstance(objectives, Sequence) else [objectives]

    def get_cost(self, info_dict: dict[str, Any], action_candidates: Any) -> Any:
        """See `stable_worldmodel.protocols.Costable`."""
        envs, samples, horizon, dim = action_candidates.shape
        cached = info_dict.setdefault("_latents", {})
        if not cached:
            infos = {key: value[:, 0] for key, value in info_dict.items() if not key.startswith("_")}
            cached["start"], cached["goal"] = self.dynamics.encode(infos), self.dynamics.encode_goal(infos)
        latent = _repeat(cached["start"], samples)
        goal = _repeat(cached["goal"], samples)
        actions = action_candidates.reshape(envs * samples, horizon, dim)
        latents = [latent]
        for step in range(horizon):
            latents.append(self.dynamics.predict(latents[-1], actions[:, step]))
        if isinstance(latent, np.ndarray):
            trajectory: Any = np.stack(latents, 1)
        else:
            import torch

            trajectory = torch.stack(latents, 1)
        cost: Any = sum(objective(trajectory, goal, actions) for objective in self.objectives)
        return cost.reshape(envs, samples)


def _repeat(rows: Any, times: int) -> Any:
    """Every row `times` times in succession."""
    return np.repeat(rows, times, 0) if isinstance(rows, np.ndarray) else rows.repeat_interleave(times, 0)
