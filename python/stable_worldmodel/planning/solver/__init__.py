"""Solvers, which search for action sequences of low cost.

    solver = CEMSolver(cost=cost, num_samples=300, n_steps=30, topk=30)
    policy = swm.policy.WorldModelPolicy(solver, config=swm.PlanConfig(horizon=5, receding_horizon=5))

`cost` is any object with `get_cost` (a PyTorch module, a model of `swm.wm`, a `ShootingCostEvaluator`, …), or `"simulator"`,
which plans with the environment itself. The search runs in the engine for all environments together; the plan of an
environment depends on the seed and the infos of that environment, not on other environments. `callbacks` run after every
iteration. A user-defined solver is any object with `configure(action_space, n_envs, config)` and
`solve(info_dict, init_action)`.
"""

from .categorical_cem import CategoricalCEMSolver
from .cem import CEMSolver
from .engine import EngineSolver
from .gd import GradientSolver
from .grasp import GRASPSolver
from .icem import ICEMSolver
from .lagrangian import AugmentedLagrangianSolver, LagrangianSolver
from .mppi import MPPISolver
from .pgd import PGDSolver
from .predictive_sampling import PredictiveSamplingSolver
from .solver import Solver

__all__ = [
    "AugmentedLagrangianSolver",
    "CEMSolver",
    "CategoricalCEMSolver",
    "EngineSolver",
    "GRASPSolver",
    "GradientSolver",
    "ICEMSolver",
    "LagrangianSolver",
    "MPPISolver",
    "PGDSolver",
    "PredictiveSamplingSolver",
    "Solver",
]
