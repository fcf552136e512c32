"""`ShootingCostEvaluator`: the cost of candidates, from a world model and an objective.

cost = ShootingCostEvaluator(model, WeightedSum([(1.0, GoalMSE()), (0.1, ControlPenalty())]))
solver = CEMSolver(cost=cost)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import nn

from ..protocols import Dynamics, Objective

__all__ = ["ShootingCostEvaluator", "default_goal_encode", "flat_goal_encode", "split_goal_encode"]

#: A function `(model, infos) -> infos`, which adds the embeddings of the goal to infos `(B, S, T, ..)`.
GoalEncode = Callable[[Any, dict[str, Any]], Any]


def _goal_infos(info_dict: Mapping[str, Any]) -> dict[str, Any]:
    """The infos `(B, T, ..)` of the goal. All candidates have the same goal, so the first one's is used.

    `goal` replaces `pixels`, and every other column `goal_NAME` replaces `NAME`. No action belongs to a goal.
    """
    first = {key: value[:, 0] for key, value in info_dict.items() if torch.is_tensor(value) and value.ndim > 1}
    if "goal" not in first:
        raise KeyError(f"the infos have no 'goal' to plan for; they have {', '.join(sorted(map(str, info_dict)))}")
    goal = {key: value for key, value in first.items() if not key.startswith("goal") and key != "action"}
    goal |= {key.removeprefix("goal_"): value for key, value in first.items() if key.startswith("goal_")}
    return {**goal, "pixels": first["goal"]}


def default_goal_encode(model: Dynamics, info_dict: dict[str, Any]) -> dict[str, Any]:
    """Adds `goal_emb` `(B, T, ..)`: the embedding `emb` of the goal."""
    info_dict["goal_emb"] = model.encode(_goal_infos(info_dict))["emb"]
    return info_dict


def flat_goal_encode(model: Any, info_dict: dict[str, Any]) -> dict[str, Any]:
    """Adds `goal_emb` `(B, T, P, D)`, the embedding of the goal with all its columns, for `PreJEPA`.

    The columns of the embedding are those that the model encodes, except for the action.
    """
    split_goal_encode(model, info_dict)
    return info_dict


def split_goal_encode(model: Any, info_dict: dict[str, Any]) -> dict[str, Any]:
    """Adds an embedding of the goal for each column, for `PreJEPA`: `pixels_goal_emb` `(B, T, P, D)` and `NAME_goal_emb`.

    `GoalMSE(pred_key="predicted_pixels_emb", goal_key="pixels_goal_emb")` compares one of them.
    """
    columns = [name for name in getattr(model, "extra_encoders", {}) if name != "action"]
    goal = _goal_infos(info_dict)
    goal |= {f"goal_{name}": goal[name] for name in columns if name in goal}
    goal = model.encode(goal, pixels_key="pixels", emb_keys=columns, prefix="goal_", target="goal_emb")
    info_dict.update((key, value) for key, value in goal.items() if key.endswith("goal_emb"))
    return info_dict


class ShootingCostEvaluator(nn.Module):
    """A `Costable` made of a world model: rolls candidates out and evaluates an objective on the predictions.

    Args:
        model: A `stable_worldmodel.protocols.Dynamics`: `encode(infos)` and `rollout(infos, candidates)`.
        objective: A callable from infos to costs `(B, S)`.
        constraints: Callables from infos to values `(B, S)`, satisfied when at most 0. With constraints, the evaluator has
            `get_constraints`, which `LagrangianSolver` requires.
        encode_goal: Adds the embeddings of the goal to the infos, once for each search.
    """

    def __init__(
        self,
        model: Dynamics,
        objective: Objective,
        constraints: Sequence[Objective] | None = None,
        encode_goal: GoalEncode = default_goal_encode,
    ) -> None:
        super().__init__()
        if not (callable(getattr(model, "encode", None)) and callable(getattr(model, "rollout", None))):
            raise TypeError(f"{type(model).__name__} is not a Dynamics: expected encode(infos) and rollout(infos, candidates)")
        if not callable(objective):
            raise TypeError(f"objective: expected a callable from infos to costs, got {type(objective).__name__}")
        self.model = model
        self.objective = objective
        self.constraints = list(constraints or ())
        self.encode_goal = encode_goal
        self._modules_of_constraints = nn.ModuleList(c for c in self.constraints if isinstance(c, nn.Module))
        if self.constraints:
            self.get_constraints = self._constraint_values

    @property
    def action_block(self) -> int:
        """Environment steps in one step of the model."""
        return int(getattr(self.model, "action_block", 1))

    @property
    def process(self) -> dict[str, Any]:
        """The scalers of the model's columns, which policies use by default."""
        return dict(getattr(self.model, "process", {}))

    def get_cost(self, info_dict: dict[str, Any], action_candidates: torch.Tensor) -> torch.Tensor:
        """The costs `(B, S)` of candidates `(B, S, H, A)`, for infos `(B, S, T, ..)`."""
        return self.criterion(self._predicted(info_dict, action_candidates), action_candidates)

    def criterion(self, info_dict: dict[str, Any], action_candidates: torch.Tensor | None = None) -> torch.Tensor:
        """The costs `(B, S)` of infos that hold the predictions of a rollout."""
        if action_candidates is not None:
            info_dict["action_candidates"] = action_candidates
        return self.objective(info_dict)  # type: ignore[no-any-return]

    def _constraint_values(self, info_dict: dict[str, Any], action_candidates: torch.Tensor) -> torch.Tensor:
        """The constraint values `(B, S, C)`."""
        info_dict = self._predicted(info_dict, action_candidates)
        return torch.stack([constraint(info_dict) for constraint in self.constraints], -1)

    def _predicted(self, info_dict: dict[str, Any], action_candidates: torch.Tensor) -> dict[str, Any]:
        if not any(str(key).endswith("goal_emb") for key in info_dict):
            encoded = self.encode_goal(self.model, info_dict)
            if torch.is_tensor(encoded):
                info_dict["goal_emb"] = encoded
            elif isinstance(encoded, Mapping) and encoded is not info_dict:
                info_dict.update((key, value) for key, value in encoded.items() if str(key).endswith("goal_emb"))
        info_dict["action_candidates"] = action_candidates
        predicted = self.model.rollout(info_dict, action_candidates)
        return info_dict if predicted is None else predicted
