"""`PGDSolver`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from .discrete import DiscreteSolver
from .engine import summed_costs

__all__ = ["PGDSolver"]


class PGDSolver(DiscreteSolver):
    """Projected gradient descent for discrete actions, on the probabilities of the options.

    `solve` returns the indices of options as `actions`, `(B, horizon, choices)` of int64, and the `cost` that
    `GradientSolver` describes.

    Args:
        cost, n_steps, batch_size, var_scale, num_samples, action_noise, device, seed: As for `GradientSolver`.
        **settings: As for `CEMSolver`, and `callbacks`.
    """

    id = "pgd"
    _descends = True
    _names: ClassVar[Mapping[str, str]] = {"num_samples": "samples", "n_steps": "iterations", "var_scale": "sigma"}

    def __init__(
        self,
        cost: Any = None,
        n_steps: int = 30,
        batch_size: int | None = None,
        var_scale: float = 1,
        num_samples: int = 100,
        action_noise: float = 0.0,
        device: Any = "cpu",
        seed: int = 1234,
        **settings: Any,
    ) -> None:
        named = {"n_steps": n_steps, "var_scale": var_scale, "num_samples": num_samples, "action_noise": action_noise}
        super().__init__(cost, batch_size=batch_size, device=device, seed=seed, **{**named, **settings})

    def _outputs(self, result: dict[str, Any], watched: Any) -> dict[str, Any]:
        cost = summed_costs(result["trace"], self._all_settings()["samples"])
        return {**super()._outputs(result, watched), "cost": cost}

    def init_action(self, actions: Any = None, from_scalar: bool = False) -> Any:
        """The probabilities at which the search starts, a tensor `(n_envs, horizon, action_simplex_dim)`.

        Args:
            actions: One-hot vectors `(n_envs, at most horizon, action_simplex_dim)`, padded with zeros; zeros for `None`.
            from_scalar: Whether `actions` are the indices of options, `(n_envs, at most horizon, choices)`.
        """
        actions = self._vectors(actions, from_scalar)
        return self._initial(self.n_envs if actions is None else len(actions), actions)

    def solve(self, info_dict: dict[str, Any], init_action: Any = None, from_scalar: bool = False) -> dict[str, Any]:
        """See `EngineSolver.solve`; with `from_scalar`, `init_action` has the indices of options in any case."""
        return super().solve(info_dict, self._vectors(init_action, from_scalar))
