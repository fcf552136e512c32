"""`ICEMSolver`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from .callbacks import Callback
from .gaussian import GaussianSolver

__all__ = ["ICEMSolver"]


class ICEMSolver(GaussianSolver):
    """iCEM: CEM with coloured noise, elites carried over between iterations, and momentum.

    Args:
        cost, batch_size, num_samples, var_scale, n_steps, topk, device, seed, callbacks: As for `CEMSolver`.
        noise_beta: The exponent of the noise's spectrum, at most 10: 0 is white, 1 pink, 2 red.
        alpha: The weight of the previous distribution.
        n_elite_keep: Elites that are candidates of the next iteration.
        return_mean: Must be true: the plan is the mean of the distribution.
        **settings: As for `CEMSolver`.
    """

    id = "icem"
    _names: ClassVar[Mapping[str, str]] = {
        **GaussianSolver._names,
        "noise_beta": "beta",
        "alpha": "momentum",
        "n_elite_keep": "keep",
    }

    def __init__(
        self,
        cost: Any = None,
        batch_size: int | None = None,
        num_samples: int = 300,
        var_scale: float = 1,
        n_steps: int = 30,
        topk: int = 30,
        noise_beta: float = 2.0,
        alpha: float = 0.1,
        n_elite_keep: int = 5,
        return_mean: bool = True,
        device: Any = "cpu",
        seed: int = 1234,
        callbacks: Sequence[Callback] | None = None,
        **settings: Any,
    ) -> None:
        if not return_mean:
            raise ValueError("ICEMSolver: return_mean=False is not supported; the plan is the mean of the distribution")
        named = {"num_samples": num_samples, "var_scale": var_scale, "n_steps": n_steps, "topk": topk}
        named |= {"noise_beta": noise_beta, "alpha": alpha, "n_elite_keep": n_elite_keep}
        super().__init__(cost, batch_size=batch_size, device=device, seed=seed, callbacks=callbacks, **{**named, **settings})
        self._given = {"return_mean": return_mean}
