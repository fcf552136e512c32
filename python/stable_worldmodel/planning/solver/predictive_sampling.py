"""`PredictiveSamplingSolver`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from .engine import EngineSolver

__all__ = ["PredictiveSamplingSolver"]


class PredictiveSamplingSolver(EngineSolver):
    """Predictive sampling: samples candidates once and returns the cheapest one.

    Args:
        cost, batch_size, num_samples, device, seed: As for `CEMSolver`.
        noise_scale: The standard deviation of the candidates.
        **settings: As for `CEMSolver`, and `callbacks`.
    """

    id = "predictive_sampling"
    _names: ClassVar[Mapping[str, str]] = {"num_samples": "samples", "noise_scale": "sigma"}

    def __init__(
        self,
        cost: Any = None,
        batch_size: int | None = None,
        num_samples: int = 300,
        noise_scale: float = 1.0,
        device: Any = "cpu",
        seed: int = 1234,
        **settings: Any,
    ) -> None:
        named = {"num_samples": num_samples, "noise_scale": noise_scale}
        super().__init__(cost, batch_size=batch_size, device=device, seed=seed, **{**named, **settings})

    def init_nominal(self, n_envs: int, actions: Any = None) -> Any:
        """The plan that the candidates are drawn around, a tensor `(n_envs, horizon, action_dim)`."""
        return self._initial(n_envs, actions)
