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

__all__ = ["Watched", "choice_shape", "view"]


class Watched:
    """An adapter that calls callbacks after every iteration.

    Args:
        adapter: The adapter of the model, with its infos set.
        callbacks: The callbacks.
        elites: The number of elites; 0 for gradient solvers.
        sigma: The initial standard deviation of sampling solvers.
        momentum: The weight of the previous distribution.
        limits: The bounds of an action, `(low, high)`, which callbacks get as `action_low` and `action_high`.

    Without callbacks, only the last iteration is kept, unless the distribution depends on all of them.
    """

    def __init__(
        self,
        adapter: Adapter,
        callbacks: Sequence[Callback],
        elites: int,
        sigma: float,
        momentum: float,
        limits: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> None:
        self._adapter, self._callbacks, self._elites, self._momentum = adapter, callbacks, elites, momentum
        self._spread: Any = sigma
        #: The number of options of every choice of a model step, for discrete actions.
        self._options: list[int] | None = None
        self._smoothing, self._probs = 0.0, np.empty(0, np.float32)
        self._limits = {} if limits is None else {"action_low": view(limits[0]), "action_high": view(limits[1])}
        self._last: tuple[np.ndarray, np.ndarray] | None = None
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

    def choose(self, options: list[int], smoothing: float, initial: np.ndarray) -> None:
        """Makes the distribution one of discrete choices, with these probabilities `(H, dim)` before the search."""
        self._options, self._smoothing, self._probs = options, smoothing, initial

    def fitted(self) -> Any:
        """The standard deviation, or the probabilities, that were fitted in the last iteration."""
        if self._last is not None:
            self._fit(*self._last)
            self._last = None
        return self._shaped(self._probs) if self._options is not None else view(self._spread)

    def cost(self, candidates: np.ndarray) -> np.ndarray:
        """See `Adapter.cost`. A call of a sampling solver is an iteration; a gradient solver's is its final comparison."""
        if not self._elites:
            return self._adapter.cost(candidates)
        known = self._next()
        if known is not None:
            return known  # type: ignore[no-any-return]
        costs = self._adapter.cost(candidates)
        if self._callbacks:
            self.recorded.append(costs)
            self._call(candidates, costs, self._fit(candidates, costs))
        elif self._momentum:
            self._fit(candidates, costs)
        else:
            self._last = (candidates, costs)
        return costs

    def cost_and_gradient(self, candidates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `Adapter.cost_and_gradient`."""
        known = self._next()
        if known is not None:
            return known  # type: ignore[no-any-return]
        costs, gradient = self._adapter.cost_and_gradient(candidates)
        if not self._callbacks:
            return costs, gradient
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

    def _fit(self, candidates: np.ndarray, costs: np.ndarray) -> dict[str, Any]:
        """The elites and the distribution after an iteration."""
        chosen = np.argsort(costs, axis=1, kind="stable")[:, : self._elites]
        elites = np.take_along_axis(candidates, chosen[:, :, None, None], 1)
        state = {"topk_vals": np.take_along_axis(costs, chosen, 1), "topk_inds": chosen}
        shared = {name: view(value) for name, value in state.items()}
        if self._options is None:
            return {**shared, "topk_candidates": view(elites), **self._gaussian(candidates[:, 0], elites), **self._limits}
        keep, previous = self._momentum, np.broadcast_to(self._probs, elites[:, 0].shape).copy()
        sizes = np.repeat(self._options, self._options).astype(np.float32)
        smoothed = (elites.mean(1) + self._smoothing) / (1 + sizes * self._smoothing)
        self._probs = (keep * previous + (1 - keep) * smoothed).astype(np.float32)
        shaped = {"topk_candidates": elites, "probs": self._probs, "prev_probs": previous}
        return {**shared, **{name: self._shaped(value) for name, value in shaped.items()}}

    def _shaped(self, values: np.ndarray) -> Any:
        """Values `(.., dim)` as `(.., choices, options)`, if all choices have equally many options."""
        shape = choice_shape(self._options or [])
        return view(values if shape is None else values.reshape(*values.shape[:-1], *shape))

    def _gaussian(self, before: np.ndarray, elites: np.ndarray) -> dict[str, Any]:
        """The moments after an iteration; `before` is the mean of the distribution, its first candidate."""
        keep = self._momentum
        previous = np.broadcast_to(np.asarray(self._spread, np.float32), before.shape).copy()
        mean = keep * before + (1 - keep) * elites.mean(1)
        deviation = elites.std(1, ddof=1) if self._elites > 1 else np.zeros_like(before)
        self._spread = keep * previous + (1 - keep) * deviation
        state = {"mean": mean, "var": self._spread, "prev_mean": before, "prev_var": previous}
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


def choice_shape(options: Sequence[int]) -> tuple[int, int] | None:
    """The number of choices and of their options; `None` if the choices differ in their options."""
    return (len(options), options[0]) if len(set(options)) == 1 else None


def view(array: np.ndarray) -> Any:
    """The array as a tensor that shares its memory, if torch is installed."""
    if not has_torch():
        return array
    import torch

    return torch.from_numpy(np.ascontiguousarray(array))
