"""`CategoricalCEMSolver`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from .callbacks import Callback
from .discrete import DiscreteSolver

__all__ = ["CategoricalCEMSolver"]


class CategoricalCEMSolver(DiscreteSolver):
    """CEM for discrete actions: refits the probability of every option.

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
        """The initial probabilities, a tensor `(n_envs, horizon, action_dim)`: equal for all options of a choice."""
        import torch

        return torch.from_numpy(self._uniform()).to(self.dtype).expand(n_envs, self.horizon, -1).clone()
