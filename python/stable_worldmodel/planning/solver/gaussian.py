"""`GaussianSolver`: what the solvers have in common that sample plans from a Gaussian."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from .engine import EngineSolver

__all__ = ["GaussianSolver"]


class GaussianSolver(EngineSolver):
    """Base class of the solvers that sample plans from a Gaussian.

    Results of `solve` also have `mean` and `var`: lists with the final mean and standard deviation, `(B, horizon, dim)`.
    """

    _names: ClassVar[Mapping[str, str]] = {
        "num_samples": "samples",
        "n_steps": "iterations",
        "topk": "elites",
        "var_scale": "sigma",
    }

    def _outputs(self, result: dict[str, Any], watched: Any) -> dict[str, Any]:
        return {} if watched is None else {"mean": [result["actions"]], "var": [watched.fitted()]}

    def init_action_distrib(self, n_envs: int, actions: Any = None) -> tuple[Any, Any]:
        """The initial mean and standard deviation, tensors `(n_envs, horizon, action_dim)`.

        Args:
            n_envs: The number of environments.
            actions: The initial mean `(n_envs, at most horizon, action_dim)`, padded with zeros; zeros for `None`.
        """
        import torch

        mean = self._initial(n_envs, actions)
        return mean, float(self.settings.get("sigma", 1.0)) * torch.ones_like(mean)
