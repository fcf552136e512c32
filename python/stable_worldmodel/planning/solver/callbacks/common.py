"""`Callback`: what runs after every iteration of a search, and the recorders that fit every solver."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["BestCostRecorder", "Callback", "MeanCostRecorder", "StopSearch"]


class StopSearch(Exception):
    """Raised by a callback to end the search after this iteration: the plan is the one of the iterations so far."""


#: The parts of the state that some solvers have.
_OF_SOME_SOLVERS = frozenset(
    ("topk_vals", "topk_inds", "topk_candidates", "mean", "var", "prev_mean", "prev_var", "probs", "prev_probs")
    + ("action_low", "action_high", "params", "gradient")
)


class Callback:
    """Runs after every iteration of a search; `history` holds what `compute` returned, for each batch and iteration.

        class Stalled(Callback):
            def compute(self, **state):
                best = state["costs"].min()
                if self.values and best > self.values[-1] - 1e-3:
                    raise StopSearch
                return float(best)

    The state of an iteration (torch tensors if torch is installed, else arrays; B environments, S candidates, K elites, H
    steps, A the dimension of a step): `step`; `candidates` `(B, S, H, A)` and `costs` `(B, S)`. Sampling solvers add the
    elites, cheapest first: `topk_vals` `(B, K)`, `topk_inds` `(B, K)`, `topk_candidates` `(B, K, H, A)`, and the moments of
    the distribution after the iteration, `mean` and `var` `(B, H, A)` (a standard deviation, which MPPI and predictive
    sampling never change), with `prev_mean` and `prev_var`, the moments that the candidates were drawn from. For discrete
    actions, these are `probs` and `prev_probs`. The gradient solvers add `params`, the candidates with their gradient as
    `grad`, and `gradient`.

    Args:
        reduction: How the values of the environments are joined: `"mean"`, `"sum"`, or `"none"` for a list.
    """

    #: The key of the history in the result of `solve`; the name of the class for `None`. A second callback with the same key
    #: has `_2` behind it.
    name: str | None = None

    def __init__(self, reduction: str = "mean") -> None:
        if reduction not in ("mean", "sum", "none"):
            raise ValueError(f"reduction: {reduction!r}; expected 'mean', 'sum' or 'none'")
        self.reduction = reduction
        #: The values of finished batches, `[batch][iteration]`.
        self.history: list[list[Any]] = []
        #: The values of the batch that is being planned.
        self.values: list[Any] = []

    @property
    def output_key(self) -> str:
        """The key of the history in the result of `solve`."""
        return self.name or type(self).__name__

    def compute(self, **state: Any) -> Any:
        """The value of an iteration; `None` is not recorded."""
        raise NotImplementedError(f"{type(self).__name__} has no compute(**state)")

    def __call__(self, **state: Any) -> None:
        """Records the value of an iteration.

        Raises:
            ValueError: If `compute` reads a part of the state that this solver does not have.
        """
        try:
            value = self.compute(**state)
        except KeyError as error:
            missing = next(iter(error.args), None)
            if missing not in _OF_SOME_SOLVERS or missing in state:
                raise
            problem = f"reads {missing!r}, which the state of this solver does not have"
            raise ValueError(f"{type(self).__name__}: {problem}; it has {', '.join(sorted(state))}") from error
        if value is not None:
            self.values.append(value)

    def reset(self) -> None:
        """Forgets all values, before a search."""
        self.history, self.values = [], []

    def start_batch(self) -> None:
        """Begins the history of the next batch of environments."""
        self._finish_batch()

    def end_solve(self) -> None:
        """Ends the search."""
        self._finish_batch()

    def _finish_batch(self) -> None:
        if self.values:
            self.history.append(self.values)
        self.values = []

    def _reduce(self, values: Any) -> Any:
        """The values `(B,)` of the environments as one number, or as a list."""
        values = array(values)
        if self.reduction == "none":
            return values.tolist()
        return float(values.mean() if self.reduction == "mean" else values.sum())


class BestCostRecorder(Callback):
    """Records the lowest cost among the candidates."""

    def compute(self, **state: Any) -> Any:
        return self._reduce(array(state["costs"]).min(1))


class MeanCostRecorder(Callback):
    """Records the mean cost of the candidates."""

    def compute(self, **state: Any) -> Any:
        return self._reduce(array(state["costs"]).mean(1))


def array(value: Any) -> np.ndarray:
    """A tensor of any device, or an array, as an array."""
    return np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)
