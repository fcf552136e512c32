"""`GRASPSolver`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from .engine import EngineSolver

__all__ = ["GRASPSolver"]


class GRASPSolver(EngineSolver):
    """GRASP: optimises states and actions of all model steps in parallel; the model is a `planning.LatentDynamics`.

    Callbacks get the loss of states and actions as the cost of an iteration, and in a synchronisation the model's cost.
    """

    id = "grasp"
    _descends = True
    _names: ClassVar[Mapping[str, str]] = {"n_steps": "iterations"}
