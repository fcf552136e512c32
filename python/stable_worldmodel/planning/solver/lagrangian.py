"""`LagrangianSolver`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from .engine import EngineSolver, summed_costs
from .hooks import view
from .optimizer import optimizer

__all__ = ["AugmentedLagrangianSolver", "LagrangianSolver"]


class LagrangianSolver(EngineSolver):
    """Augmented Lagrangian: gradient descent with a growing penalty on violated constraints (`get_constraints`).

    Args:
        cost, batch_size, num_samples, var_scale, action_noise, device, seed, optimizer_cls, optimizer_kwargs: As for
            `GradientSolver`; the cost must have `get_constraints`.
        n_steps: Steps between two updates of the multipliers.
        n_outer_steps: Updates of the multipliers.
        rho_init, rho_max, rho_scale: The first penalty, the largest penalty, and its growth in an update.
        persist_multipliers: Has no effect: the multipliers start at zero in every call, so that a plan does not depend on
            earlier ones. The last multipliers are in the result.
        **settings: As for `CEMSolver`, and `callbacks`.

    Results of `solve` also have `cost`, `[[..]]` (the sum of the costs of all candidates in every step),
    `constraint_violation`, `[x]` (the mean of the positive constraint values of the plans), and `multipliers`,
    `(B, constraints)`, those after the search. Callbacks get the costs and the gradient of the cost, without the
    constraints.
    """

    id = "lagrangian"
    _descends = True
    _names: ClassVar[Mapping[str, str]] = {
        "num_samples": "samples",
        "n_steps": "iterations",
        "var_scale": "sigma",
        "n_outer_steps": "outer_iterations",
        "rho_init": "penalty",
        "rho_max": "penalty_limit",
        "rho_scale": "penalty_growth",
    }

    def __init__(
        self,
        cost: Any = None,
        n_steps: int = 50,
        n_outer_steps: int = 5,
        batch_size: int | None = None,
        num_samples: int = 100,
        var_scale: float = 1.0,
        action_noise: float = 0.0,
        rho_init: float = 1.0,
        rho_max: float = 1e4,
        rho_scale: float = 2.0,
        persist_multipliers: bool = False,
        device: Any = "cpu",
        seed: int = 1234,
        optimizer_cls: Any = None,
        optimizer_kwargs: Mapping[str, Any] | None = None,
        **settings: Any,
    ) -> None:
        named: dict[str, Any] = {"n_steps": n_steps, "n_outer_steps": n_outer_steps, "num_samples": num_samples}
        named |= {"var_scale": var_scale, "action_noise": action_noise}
        named |= {"rho_init": rho_init, "rho_max": rho_max, "rho_scale": rho_scale}
        if optimizer_cls is not None or optimizer_kwargs is not None:
            named["optimizer"] = optimizer(optimizer_cls or "adam", optimizer_kwargs or {})
        super().__init__(cost, batch_size=batch_size, device=device, seed=seed, **{**named, **settings})
        self._given = {"optimizer_cls": optimizer_cls, "optimizer_kwargs": optimizer_kwargs}
        self._given["persist_multipliers"] = persist_multipliers

    def _outputs(self, result: dict[str, Any], watched: Any) -> dict[str, Any]:
        found: dict[str, Any] = {"cost": summed_costs(result["trace"], self._all_settings()["samples"])}
        multipliers = [search["multipliers"] for search in result["trace"]]
        found["multipliers"] = view(np.array(multipliers, np.float32))
        if watched is not None:
            values = watched.constrain(np.asarray(result["actions"])[:, None])
            found["constraint_violation"] = [float(np.maximum(values, 0).mean())]
        return found

    def init_action(self, actions: Any = None) -> Any:
        """The plan that the candidates are drawn around, a tensor `(n_envs, horizon, action_dim)`."""
        return self._initial(self.n_envs if actions is None else len(actions), actions)


AugmentedLagrangianSolver = LagrangianSolver
