"""The solvers of `stable_worldmodel.planning.solver`, under the name that the package's releases give them."""

import importlib
import sys

from ..planning.solver import (
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

__all__ = [
    "AugmentedLagrangianSolver",
    "CEMSolver",
    "CategoricalCEMSolver",
    "GRASPSolver",
    "GradientSolver",
    "ICEMSolver",
    "LagrangianSolver",
    "MPPISolver",
    "PGDSolver",
    "PredictiveSamplingSolver",
    "Solver",
]

#: The modules of `planning.solver` that are modules of this package as well.
_MODULES = (
    "callbacks",
    "callbacks.cem",
    "callbacks.common",
    "callbacks.gd",
    "categorical_cem",
    "cem",
    "gd",
    "icem",
    "lagrangian",
    "mppi",
    "pgd",
    "predictive_sampling",
    "solver",
    "utils",
)
for _name in _MODULES:
    _module = importlib.import_module(f"stable_worldmodel.planning.solver.{_name}")
    sys.modules[f"{__name__}.{_name}"] = _module
    if "." not in _name:
        setattr(sys.modules[__name__], _name, _module)
