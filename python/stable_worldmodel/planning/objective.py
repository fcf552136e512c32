"""Objectives of plans: cost terms that read the predictions of a rollout from the infos.

    objective = WeightedSum([(1.0, GoalMSE()), (0.1, ControlPenalty())])

An objective is any callable from infos to costs `(B, S)`; see `stable_worldmodel.protocols.Objective`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import nn

from ..protocols import Objective

__all__ = ["ControlPenalty", "GoalMSE", "WeightedSum"]


class GoalMSE(nn.Module):
    """The squared distance of the last predicted embedding from the last embedding of the goal.

    The goal gets no gradient.

    Args:
        pred_key: The predictions, `(B, S, T, ..)`.
        goal_key: The goals, `(B, T, ..)`, or `(B, S, T, ..)` if they are repeated for every candidate.
        reduction: `"sum"` or `"mean"` over the elements of an embedding.
    """

    def __init__(self, pred_key: str = "predicted_emb", goal_key: str = "goal_emb", reduction: str = "sum") -> None:
        super().__init__()
        if reduction not in ("sum", "mean"):
            raise ValueError(f"GoalMSE: reduction={reduction!r}; expected 'sum' or 'mean'")
        self.pred_key, self.goal_key, self.reduction = pred_key, goal_key, reduction

    def forward(self, info_dict: dict[str, Any]) -> torch.Tensor:
        """The costs `(B, S)`."""
        predicted = _entry(self, info_dict, self.pred_key)
        goal = _entry(self, info_dict, self.goal_key).detach()
        if goal.ndim == predicted.ndim - 1:
            goal = goal.unsqueeze(1)
        # The differences of candidates are small: half precision would make their costs equal.
        squares = (_single(predicted[:, :, -1]) - _single(goal[:, :, -1])).square()
        flat = squares.flatten(2) if squares.ndim > 2 else squares.unsqueeze(2)
        return flat.sum(-1) if self.reduction == "sum" else flat.mean(-1)


class ControlPenalty(nn.Module):
    """The sum of the squared actions of a plan.

    Args:
        action_key: The actions, `(B, S, H, A)`.
    """

    def __init__(self, action_key: str = "action_candidates") -> None:
        super().__init__()
        self.action_key = action_key

    def forward(self, info_dict: dict[str, Any]) -> torch.Tensor:
        """The costs `(B, S)`."""
        return _entry(self, info_dict, self.action_key).square().flatten(2).sum(-1)


class WeightedSum(nn.Module):
    """A weighted sum of objectives.

    Args:
        terms: Pairs of a weight and an objective.
    """

    def __init__(self, terms: Sequence[tuple[float, Objective]]) -> None:
        super().__init__()
        terms = [(float(weight), objective) for weight, objective in terms]
        if not terms:
            raise ValueError("WeightedSum: no terms; expected pairs of a weight and an objective")
        self.terms = terms
        # Objectives with parameters move with this module.
        self.objectives = nn.ModuleList(objective for _, objective in terms if isinstance(objective, nn.Module))

    def forward(self, info_dict: dict[str, Any]) -> torch.Tensor:
        """The costs `(B, S)`."""
        total: torch.Tensor = sum(weight * objective(info_dict) for weight, objective in self.terms)
        return total


def _single(value: torch.Tensor) -> torch.Tensor:
    """A tensor in single precision at least."""
    return value.to(torch.promote_types(value.dtype, torch.float32))


def _entry(objective: nn.Module, info_dict: dict[str, Any], key: str) -> torch.Tensor:
    if key not in info_dict:
        known = ", ".join(sorted(str(name) for name in info_dict))
        raise KeyError(f"{type(objective).__name__}: the infos have no {key!r}; they have {known}")
    value: torch.Tensor = info_dict[key]
    return value
