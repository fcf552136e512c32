"""Planning: interfaces of models, costs and solvers.

    cost = swm.planning.ShootingCostEvaluator(model, swm.planning.GoalMSE())
    solver = swm.planning.CEMSolver(cost=cost, num_samples=300, n_steps=30, topk=30)
    policy = swm.policy.WorldModelPolicy(solver, swm.PlanConfig(horizon=5, receding_horizon=5))

A cost is any object with `get_cost(info_dict, action_candidates) -> (B, S)`. `ShootingCostEvaluator` makes one of a world
model (`Dynamics`: `encode` and `rollout`) and an objective; `LatentCost` makes one of a model of one latent per observation
(`LatentDynamics`, which GRASP requires). The gradient solvers differentiate `get_cost` with torch's autograd.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..protocols import Actionable, Constrainable, Costable, Dynamics, Objective, Transformable
from .latent import ActionPenalty, GoalDistance, LatentCost, LatentDynamics, LatentObjective
from .solver import (
    AugmentedLagrangianSolver,
    CategoricalCEMSolver,
    CEMSolver,
    GradientSolver,
    GRASPSolver,
    ICEMSolver,
    LagrangianSolver,
    MPPISolver,
    PGDSolver,
    PredictiveSamplingSolver,
    Solver,
)

if TYPE_CHECKING:
    from .evaluator import ShootingCostEvaluator, default_goal_encode, flat_goal_encode, split_goal_encode
    from .objective import ControlPenalty, GoalMSE, WeightedSum

__all__ = [
    "ActionPenalty",
    "Actionable",
    "AugmentedLagrangianSolver",
    "CEMSolver",
    "CategoricalCEMSolver",
    "Constrainable",
    "ControlPenalty",
    "Costable",
    "Dynamics",
    "GRASPSolver",
    "GoalDistance",
    "GoalMSE",
    "GradientSolver",
    "ICEMSolver",
    "LagrangianSolver",
    "LatentCost",
    "LatentDynamics",
    "LatentObjective",
    "MPPISolver",
    "Objective",
    "PGDSolver",
    "PredictiveSamplingSolver",
    "ShootingCostEvaluator",
    "Solver",
    "Transformable",
    "WeightedSum",
    "default_goal_encode",
    "flat_goal_encode",
    "split_goal_encode",
]

#: The modules that import torch, by the names that they define.
_TORCH = {
    "ShootingCostEvaluator": "evaluator",
    "default_goal_encode": "evaluator",
    "flat_goal_encode": "evaluator",
    "split_goal_encode": "evaluator",
    "ControlPenalty": "objective",
    "GoalMSE": "objective",
    "WeightedSum": "objective",
}


def __getattr__(name: str) -> Any:
    if name not in _TORCH:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    value = getattr(importlib.import_module(f"{__name__}.{_TORCH[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
