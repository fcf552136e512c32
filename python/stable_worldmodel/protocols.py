"""Interfaces that models, objectives and scalers fulfil by having the methods; no class inherits from them.

Shapes: B environments, S candidates for each environment, H model steps, A the dimension of a model step (action dimension
times action block), T steps of history, D the latent dimension.
"""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

__all__ = ["Actionable", "Constrainable", "Costable", "Dynamics", "Objective", "Transformable"]


@runtime_checkable
class Costable(Protocol):
    """What a solver minimises. Solvers call `get_cost` only."""

    def criterion(self, info_dict: dict[str, Any], action_candidates: Any) -> Any:
        """The costs `(B, S)` of infos that already hold the predictions of a rollout."""
        ...

    def get_cost(self, info_dict: dict[str, Any], action_candidates: Any) -> Any:
        """The costs `(B, S)` of candidates.

        Args:
            info_dict: The infos, each `(B, S, T, ..)` with T steps of history (`history_len` of the plan config): `pixels`,
                `goal` and the other columns. Entries that the model adds remain for the rest of the search, so the
                model can cache an encoding in `info_dict`.
            action_candidates: The candidates `(B, S, H, A)`, a copy. The final `var` or `probs` of a result come from it: a
                model that changes it in place changes those, but not the plans.
        """
        ...


@runtime_checkable
class Constrainable(Protocol):
    """A `Costable` with constraints, for `LagrangianSolver`."""

    def get_constraints(self, info_dict: dict[str, Any], action_candidates: Any) -> Any:
        """The constraint values `(B, S, C)` of candidates `(B, S, H, A)`, satisfied when at most 0."""
        ...


@runtime_checkable
class Dynamics(Protocol):
    """A world model: it encodes observations and predicts the outcome of candidates."""

    def encode(self, x: Any) -> Any:
        """Adds the embeddings of the observations `(B, T, ..)` in the infos `x`, and returns the infos."""
        ...

    def rollout(self, info_dict: dict[str, Any], action_candidates: Any) -> Any:
        """Adds the predictions for candidates `(B, S, H, A)` to infos `(B, S, T, ..)`, and returns the infos."""
        ...


@runtime_checkable
class Objective(Protocol):
    """A cost term of a plan."""

    def __call__(self, info_dict: dict[str, Any]) -> Any:
        """The costs `(B, S)` of infos that hold the predictions of a rollout and `action_candidates` `(B, S, H, A)`."""
        ...


@runtime_checkable
class Actionable(Protocol):
    """A model with a policy."""

    def get_action(self, info: dict[str, Any], horizon: int = 1, prefix_actions: Any = None) -> Any:
        """The actions for infos `(B, T, ..)`.

        Args:
            info: The infos.
            horizon: The number of actions; more than one gives `(B, horizon, A)`.
            prefix_actions: Actions `(B, n, A)` that precede the first returned action.
        """
        ...


@runtime_checkable
class Transformable(Protocol):
    """A scaler with an inverse, such as `stable_worldmodel.data.ZScoreScaler`."""

    def transform(self, x: Any) -> Any:
        """Converts values to the model's units."""
        ...

    def inverse_transform(self, x: Any) -> Any:
        """Converts values back from the model's units."""
        ...
