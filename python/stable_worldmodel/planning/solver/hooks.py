"""Callbacks between the iterations of a search in the engine.

The engine shows every iteration to an `Observer`, which turns it into what callbacks get and says whether the search ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..adapter import Adapter, has_torch
from .callbacks import Callback, StopSearch

__all__ = ["Observer", "Watched", "choice_shape", "view"]


class Observer:
    """Reads the iterations of searches, and calls callbacks.

    Args:
        callbacks: The callbacks.
        elites: The number of elites; 0 for gradient solvers.
        sigma: The initial standard deviation of sampling solvers.
        momentum: The weight of the previous distribution.
        limits: The bounds of an action, `(low, high)`, which callbacks get as `action_low` and `action_high`.
        fits: Whether the spread is fitted to the elites; that of MPPI and predictive sampling never changes.
        temperature: What divides the costs of the elites before they become weights of the mean; `None` for equal weights.
    """

    def __init__(
        self,
        callbacks: Sequence[Callback],
        elites: int,
        sigma: float,
        momentum: float,
        limits: tuple[np.ndarray, np.ndarray] | None = None,
        fits: bool = True,
        temperature: float | None = None,
    ) -> None:
        self.callbacks = list(callbacks)
        self.elites, self.momentum, self._sigma, self._fits = elites, momentum, sigma, fits
        self._temperature = temperature
        #: The number of options of every choice of a model step, for discrete actions.
        self._options: list[int] | None = None
        self._smoothing, self._initial = 0.0, np.empty(0, np.float32)
        self._limits = {} if limits is None else {"action_low": view(limits[0]), "action_high": view(limits[1])}
        self._spread: Any = sigma
        self._probs = self._initial

    def choose(self, options: list[int], smoothing: float, initial: np.ndarray) -> None:
        """Makes the distribution one of discrete choices, with these probabilities `(H, dim)` before a search."""
        self._options, self._smoothing, self._initial = options, smoothing, initial
        self._probs = initial

    def begin(self, envs: int, init: np.ndarray | None = None) -> None:
        """Begins a search for this many environments, which starts at the actions `init` `(envs, H, dim)`."""
        self._spread, self._probs = self._sigma, self._initial
        if init is not None and self._options is not None:
            self._probs = self._guessed(init, self._options)
        for callback in self.callbacks:
            callback.reset()
            callback.start_batch()

    def end(self) -> None:
        """Ends the search."""
        for callback in self.callbacks:
            callback.end_solve()

    def iteration(
        self,
        index: int,
        candidates: np.ndarray,
        costs: np.ndarray,
        elites: np.ndarray | None,
        gradient: np.ndarray | None,
    ) -> bool:
        """Reads an iteration, and returns whether the search ends after it.

        Args:
            index: The index of the iteration.
            candidates: The candidates `(B, S, H, dim)`.
            costs: Their costs `(B, S)`.
            elites: The indices of the elites `(B, K)`, cheapest first, from sampling solvers.
            gradient: The gradient of the costs `(B, S, H, dim)`, from gradient solvers.
        """
        state: dict[str, Any] = {"step": index, "candidates": view(candidates), "costs": view(costs)}
        if elites is not None:
            state |= self.fit(candidates, costs, elites)
        elif gradient is not None:
            params = view(candidates)
            if has_torch():
                params.grad = view(gradient)
            state |= {"params": params, "gradient": view(gradient), "cost": state["costs"].sum()}
        stopped = False
        for callback in self.callbacks:
            try:
                callback(**state)
            except StopSearch:
                stopped = True
        return stopped

    def fitted(self) -> Any:
        """The standard deviation, or the probabilities, that were fitted in the last iteration."""
        return self._shaped(self._probs) if self._options is not None else view(self._spread)

    def fit(self, candidates: np.ndarray, costs: np.ndarray, chosen: np.ndarray) -> dict[str, Any]:
        """The elites, whose indices are `chosen`, and the distribution after an iteration."""
        chosen = chosen[:, : self.elites]
        state = {"topk_vals": np.take_along_axis(costs, chosen, 1), "topk_inds": chosen}
        shared = {name: view(value) for name, value in state.items()}
        elites, previous = self.advance(candidates, chosen)
        if self._options is not None:
            shaped = {"topk_candidates": elites, "probs": self._probs, "prev_probs": previous}
            return {**shared, **{name: self._shaped(value) for name, value in shaped.items()}}
        # The first candidate is the mean of the distribution.
        before = candidates[:, 0]
        mean = self._blended(before, self._average(elites, state["topk_vals"]))
        moments = {"mean": mean, "var": self._spread, "prev_mean": before, "prev_var": previous}
        return {**shared, "topk_candidates": view(elites), **{k: view(v) for k, v in moments.items()}, **self._limits}

    def advance(self, candidates: np.ndarray, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Fits the spread, or the probabilities, to the elites. Returns the elites and the values before."""
        elites = candidates[np.arange(len(candidates))[:, None], chosen[:, : self.elites]]
        shape = elites[:, 0].shape
        if self._options is None:
            previous = np.broadcast_to(np.asarray(self._spread, np.float32), shape).copy()
            self._spread = previous
            if self._fits:
                self._spread = self._blended(previous, elites.std(1, ddof=1, dtype=np.float64))
        else:
            previous = np.broadcast_to(self._probs, shape).copy()
            sizes = np.repeat(self._options, self._options).astype(np.float32)
            smoothed = (elites.mean(1) + self._smoothing) / (1 + sizes * self._smoothing)
            self._probs = self._blended(previous, smoothed)
        return elites, previous

    def _average(self, elites: np.ndarray, costs: np.ndarray) -> np.ndarray:
        """The mean `(B, H, dim)` of the elites, weighted by their costs `(B, K)` if there is a temperature."""
        if self._temperature is None:
            return np.asarray(elites.mean(1, dtype=np.float64))
        costs = costs.astype(np.float64)
        weights = np.exp(-(costs - costs[:, :1]) / self._temperature)
        weighted: np.ndarray = np.einsum("bk,bkhd->bhd", weights / weights.sum(1, keepdims=True), elites)
        return weighted

    def _blended(self, previous: np.ndarray, fitted: np.ndarray) -> np.ndarray:
        """The values after an iteration: the momentum is the weight of the previous ones."""
        return np.asarray(self.momentum * previous + (1 - self.momentum) * fitted, np.float32)

    def _guessed(self, init: np.ndarray, options: list[int]) -> np.ndarray:
        """The probabilities before a search that starts at `init`: half the guess, for every choice that has one."""
        sums = np.repeat(np.add.reduceat(init, np.cumsum([0, *options[:-1]]), axis=-1), options, axis=-1)
        guess = np.divide(init, sums, out=np.broadcast_to(self._initial, init.shape).copy(), where=sums > 0)
        return np.asarray(0.5 * guess + 0.5 * self._initial)

    def _shaped(self, values: np.ndarray) -> Any:
        """Values `(.., dim)` as `(.., choices, options)`, if all choices have equally many options."""
        shape = choice_shape(self._options or [])
        return view(values if shape is None else values.reshape(*values.shape[:-1], *shape))


class Watched:
    """An adapter, with its infos set, of a search without callbacks; it keeps what the final distribution depends on.

    That is the last iteration, unless a momentum makes the distribution depend on all of them.
    """

    def __init__(self, adapter: Adapter, observer: Observer) -> None:
        self._adapter, self.observer = adapter, observer
        self._last: tuple[np.ndarray, np.ndarray] | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._adapter, name)

    def observe(self, infos: Any) -> None:
        """Does nothing, because the infos of the adapter are set."""

    def cost(self, candidates: np.ndarray) -> np.ndarray:
        """See `Adapter.cost`."""
        costs = self._adapter.cost(candidates)
        if self.observer.elites and not self.observer.callbacks:
            self._last = (candidates, costs)
            if self.observer.momentum:
                self._fit()
        return costs

    def fitted(self) -> Any:
        """See `Observer.fitted`."""
        self._fit()
        return self.observer.fitted()

    def _fit(self) -> None:
        if self._last is not None:
            candidates, costs = self._last
            self.observer.advance(candidates, np.argsort(costs, axis=1, kind="stable"))
            self._last = None


def choice_shape(options: Sequence[int]) -> tuple[int, int] | None:
    """The number of choices and of their options; `None` if the choices differ in their options."""
    return (len(options), options[0]) if len(set(options)) == 1 else None


def view(array: np.ndarray) -> Any:
    """The array as a tensor that shares its memory, if torch is installed."""
    if not has_torch():
        return array
    import torch

    return torch.from_numpy(np.ascontiguousarray(array))
