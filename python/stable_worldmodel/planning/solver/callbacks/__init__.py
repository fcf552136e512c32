"""Callbacks of solvers: they run after every iteration of a search, and may end it with `StopSearch`.

costs = BestCostRecorder()
solver = CEMSolver(cost=cost, callbacks=[costs])
result = solver.solve(infos)
result["callbacks"]["BestCostRecorder"]  # [batch][iteration]
"""

from .cem import EliteCostRecorder, EliteSpreadRecorder, MeanShiftRecorder, VarNormRecorder
from .common import BestCostRecorder, Callback, MeanCostRecorder, StopSearch
from .gd import ActionNormRecorder, GradNormRecorder

__all__ = [
    "ActionNormRecorder",
    "BestCostRecorder",
    "Callback",
    "EliteCostRecorder",
    "EliteSpreadRecorder",
    "GradNormRecorder",
    "MeanCostRecorder",
    "MeanShiftRecorder",
    "StopSearch",
    "VarNormRecorder",
]
