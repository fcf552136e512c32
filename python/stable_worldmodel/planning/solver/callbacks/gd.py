"""Recorders for the gradient solvers."""

from __future__ import annotations

from typing import Any

import numpy as np

from .common import Callback, array

__all__ = ["ActionNormRecorder", "GradNormRecorder"]


class GradNormRecorder(Callback):
    """Records the norm of the gradient of the actions, averaged over the candidates.

    Args:
        reduction: As for `Callback`.
        per_step: Whether to record a list with the norm of each model step.
    """

    def __init__(self, reduction: str = "mean", per_step: bool = False) -> None:
        super().__init__(reduction)
        self.per_step = per_step

    def compute(self, **state: Any) -> Any:
        params = state["params"]
        gradient = state.get("gradient", getattr(params, "grad", None))
        if gradient is None:
            return [0.0] * params.shape[2] if self.per_step else 0.0
        gradient = array(gradient)
        if self.per_step:
            steps = np.linalg.norm(gradient, axis=-1).mean(1)
            return [self._reduce(steps[:, step]) for step in range(steps.shape[1])]
        return self._reduce(_norms(gradient))


class ActionNormRecorder(Callback):
    """Records the norm of the actions of a candidate, averaged over the candidates."""

    def compute(self, **state: Any) -> Any:
        return self._reduce(_norms(array(state["params"])))


def _norms(candidates: np.ndarray) -> np.ndarray:
    """The mean norm `(B,)` of candidates `(B, S, H, A)`."""
    norms: np.ndarray = np.linalg.norm(candidates.reshape(*candidates.shape[:2], -1), axis=-1).mean(1)
    return norms
