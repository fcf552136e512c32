"""Recorders for the solvers that fit a distribution to elites: CEM and iCEM."""

from __future__ import annotations

from typing import Any

import numpy as np

from .common import Callback, array

__all__ = ["EliteCostRecorder", "EliteSpreadRecorder", "MeanShiftRecorder", "VarNormRecorder"]


class EliteCostRecorder(Callback):
    """Records the mean, the lowest and the highest cost of the elites, as a dict."""

    def compute(self, **state: Any) -> Any:
        costs = array(state["topk_vals"])
        statistics = {"mean": costs.mean(1), "min": costs.min(1), "max": costs.max(1)}
        return {name: self._reduce(values) for name, values in statistics.items()}


class VarNormRecorder(Callback):
    """Records the mean spread `var` of the distribution over all elements of a plan."""

    def compute(self, **state: Any) -> Any:
        spread = array(state["var"])
        return self._reduce(spread.reshape(len(spread), -1).mean(1))


class MeanShiftRecorder(Callback):
    """Records the distance between the distribution's mean before and after an iteration."""

    def compute(self, **state: Any) -> Any:
        before = state.get("prev_mean")
        if before is None:
            return None
        shift = array(state["mean"]) - array(before)
        return self._reduce(np.linalg.norm(shift.reshape(len(shift), -1), axis=1))


class EliteSpreadRecorder(Callback):
    """Records the standard deviation of the elites, averaged over all elements of a plan; 0 for a single elite."""

    def compute(self, **state: Any) -> Any:
        elites = array(state["topk_candidates"])
        spread = elites.std(1, ddof=min(1, elites.shape[1] - 1))
        return self._reduce(spread.reshape(len(spread), -1).mean(1))
