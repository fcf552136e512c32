"""Callbacks between the iterations of a search in the engine.

The engine calls the model once for each iteration, so the adapter of the model is where an iteration ends: `Watched` calls
the callbacks there. When a callback ends the search, the engine's search is repeated with fewer iterations and the recorded
costs, which gives the plan of these iterations without a call of the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..adapter import Adapter, has_torch
from .callbacks import Callback, StopSearch

__all__ = ["Watched"]


class Watched:
    """An adapter that calls callbacks after every iteration.

    Args:
        adapter: The adapter of the model, with its infos set.
        callbacks: The callbacks.
        elites: The number of elites; 0 for gradient solvers.
        sigma: The initial standard deviation of sampling solvers.
        momentum: The weight of the previous distribution.
    """

    def __init__(self, adapter: Adapter, callbacks: Sequence[Callback], elites: int, sigma: float, momentum: float) -> None:
        self._adapter, self._callbacks, self._elites, self._momentum = adapter, callbacks, elites, momentum
        self._spread: Any = sigma
        #: What the model returned in every iteration.
        self.recorded: list[Any] = []
        self._replayed: int | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._adapter, name)

    def observe(self, infos: Any) -> None:
        """Does nothing, because the infos of the adapter are set."""

    def replay(self) -> None:
        """Makes the next search get the recorded results."""
        self._replayed = 0

    def cost(self, candidates: np.ndarray) -> np.ndarray:
        """See `Adapter.cost`. A call of a sampling solver is an iteration; a gradient solver's is its final comparison."""
        if not self._elites:
            return self._adapter.cost(candidates)
        known = self._next()
        if known is not None:
            return known  # type: ignore[no-any-return]
        costs = self._adapter.cost(candidates)
        self.recorded.append(costs)
        self._call(candidates, costs, self._sampling(candidates, costs))
        return costs

    def cost_and_gradient(self, candidates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `Adapter.cost_and_gradient`."""
        known = self._next()
        if known is not None:
            return known  # type: ignore[no-any-return]
        costs, gradient = self._adapter.cost_and_gradient(candidates)
        self.recorded.append((costs, gradient))
        params = view(candidates)
        if has_torch():
            params.grad = view(gradient)
        self._call(candidates, costs, {"params": params, "gradient": view(gradient), "cost": view(costs).sum()})
        return costs, gradient

    def _next(self) -> Any:
        if self._replayed is None:
            return None
        self._replayed += 1
        return self.recorded[self._replayed - 1]

    def _sampling(self, candidates: np.ndarray, costs: np.ndarray) -> dict[str, Any]:
        """The elites and moments after an iteration. The first candidate is the mean of the distribution."""
        chosen = np.argsort(costs, axis=1, kind="stable")[:, : self._elites]
        elites = np.take_along_axis(candidates, chosen[:, :, None, None], 1)
        before, keep = candidates[:, 0], self._momentum
        previous = np.broadcast_to(np.asarray(self._spread, np.float32), before.shape).copy()
        mean = keep * before + (1 - keep) * elites.mean(1)
        deviation = elites.std(1, ddof=1) if self._elites > 1 else np.zeros_like(before)
        self._spread = keep * previous + (1 - keep) * deviation
        state = {
            "topk_vals": np.take_along_axis(costs, chosen, 1),
            "topk_inds": chosen,
            "topk_candidates": elites,
            "mean": mean,
            "var": self._spread,
            "prev_mean": before,
            "prev_var": previous,
            "probs": mean,
        }
        return {name: view(value) for name, value in state.items()}

    def _call(self, candidates: np.ndarray, costs: np.ndarray, state: dict[str, Any]) -> None:
        shared = {"step": len(self.recorded) - 1, "candidates": view(candidates), "costs": view(costs)}
        stopped = None
        for callback in self._callbacks:
            try:
                callback(**shared, **state)
            except StopSearch as stop:
                stopped = stop
        if stopped is not None:
            raise stopped


def view(array: np.ndarray) -> Any:
    """The array as a tensor that shares its memory, if torch is installed."""
    if not has_torch():
        return array
    import torch

    return torch.from_numpy(np.ascontiguousarray(array))
