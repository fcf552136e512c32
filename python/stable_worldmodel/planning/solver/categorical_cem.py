"""`CategoricalCEMSolver`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from .callbacks import Callback
from .discrete import DiscreteSolver
from .hooks import Observer, choice_shape

__all__ = ["CategoricalCEMSolver"]


class CategoricalCEMSolver(DiscreteSolver):
    """CEM for discrete actions: refits the probability of every option.

    Results of `solve` also have `probs`: a list with the final probabilities, `(B, horizon, action_block, options)`, or
    `(B, horizon, action_simplex_dim)` if choices differ in their options.

    Args:
        cost, batch_size, num_samples, n_steps, topk, device, seed, callbacks: As for `CEMSolver`.
        smoothing: Added to the frequency of every option among the elites.
        alpha: The weight of the previous distribution.
        **settings: As for `CEMSolver`.
    """

    id = "categorical_cem"
    _names: ClassVar[Mapping[str, str]] = {
        "num_samples": "samples",
        "n_steps": "iterations",
        "topk": "elites",
        "alpha": "momentum",
    }

    def __init__(
        self,
        cost: Any = None,
        batch_size: int | None = None,
        num_samples: int = 300,
        n_steps: int = 30,
        topk: int = 30,
        smoothing: float = 0.0,
        alpha: float = 0.0,
        device: Any = "cpu",
        seed: int = 1234,
        callbacks: Sequence[Callback] | None = None,
        **settings: Any,
    ) -> None:
        named = {"num_samples": num_samples, "n_steps": n_steps, "topk": topk, "smoothing": smoothing, "alpha": alpha}
        super().__init__(cost, batch_size=batch_size, device=device, seed=seed, callbacks=callbacks, **{**named, **settings})

    def init_probs(self, n_envs: int) -> Any:
        """The initial probabilities, shaped as `probs` of a result: equal for all options of a choice."""
        import torch

        flat = torch.from_numpy(self._uniform()).to(self.dtype).expand(n_envs, self.horizon, -1).clone()
        shape = choice_shape(self._options())
        return flat if shape is None else flat.reshape(n_envs, self.horizon, *shape)

    def _observer(self) -> Observer:
        observer = super()._observer()
        settings = self._all_settings()
        initial = np.broadcast_to(self._uniform(), (self.horizon, self._plan_dim))
        observer.choose(self._options(), float(settings["smoothing"]), initial)
        return observer

    def _outputs(self, result: dict[str, Any], watched: Any) -> dict[str, Any]:
        found = super()._outputs(result, watched)
        return found if watched is None else {**found, "probs": [watched.fitted()]}
