"""`MPPISolver`."""

from __future__ import annotations

from typing import Any

from .gaussian import GaussianSolver

__all__ = ["MPPISolver"]


class MPPISolver(GaussianSolver):
    """Model predictive path integral: moves the mean to the average of the samples, weighted by their costs.

    Args:
        cost, batch_size, num_samples, var_scale, n_steps, topk, device, seed: As for `CEMSolver`.
        temperature: Divides the costs before they become weights.
        **settings: As for `CEMSolver`, and `callbacks`.
    """

    id = "mppi"

    def __init__(
        self,
        cost: Any = None,
        batch_size: int | None = None,
        num_samples: int = 300,
        var_scale: float = 1.0,
        n_steps: int = 30,
        topk: int = 30,
        temperature: float = 0.5,
        device: Any = "cpu",
        seed: int = 1234,
        **settings: Any,
    ) -> None:
        named = {"num_samples": num_samples, "var_scale": var_scale, "n_steps": n_steps, "topk": topk}
        named["temperature"] = temperature
        super().__init__(cost, batch_size=batch_size, device=device, seed=seed, **{**named, **settings})

    def _outputs(self, result: dict[str, Any], watched: Any) -> dict[str, Any]:
        actions = result["actions"]
        # The spread of the samples never changes.
        return {"mean": [actions], "var": [0 * actions + float(self._all_settings()["sigma"])]}
