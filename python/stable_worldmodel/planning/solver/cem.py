"""`CEMSolver`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from .callbacks import Callback
from .gaussian import GaussianSolver

__all__ = ["CEMSolver"]


class CEMSolver(GaussianSolver):
    """Cross-entropy method: refits a Gaussian to the cheapest samples.

    Args:
        cost: What to minimise: an object with `get_cost`, a model of `swm.wm`, or `"simulator"`.
        batch_size: The number of environments in one call of the cost; all of them for `None`. Plans do not depend on it.
        num_samples: Candidates in an iteration.
        var_scale: The initial standard deviation.
        n_steps: Iterations.
        topk: Candidates that the Gaussian is refitted to.
        device: The device of the tensors that the cost gets.
        seed: Determines the plans.
        callbacks: Called after every iteration.
        **settings: `model`, another name of `cost`, or settings by their names in `swm solvers`.
    """

    id = "cem"

    def __init__(
        self,
        cost: Any = None,
        batch_size: int | None = None,
        num_samples: int = 300,
        var_scale: float = 1,
        n_steps: int = 30,
        topk: int = 30,
        device: Any = "cpu",
        seed: int = 1234,
        callbacks: Sequence[Callback] | None = None,
        **settings: Any,
    ) -> None:
        super().__init__(
            cost,
            batch_size=batch_size,
            device=device,
            seed=seed,
            callbacks=callbacks,
            **{"num_samples": num_samples, "var_scale": var_scale, "n_steps": n_steps, "topk": topk, **settings},
        )
