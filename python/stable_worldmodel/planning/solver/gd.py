"""`GradientSolver`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from .callbacks import Callback
from .engine import EngineSolver, summed_costs
from .optimizer import optimizer

__all__ = ["GradientSolver"]


class GradientSolver(EngineSolver):
    """Gradient descent on the cost from several initial action sequences.

    Args:
        cost, batch_size, device, seed, callbacks: As for `CEMSolver`; the cost must be differentiable.
        n_steps: Steps.
        var_scale: The standard deviation of the initial candidates.
        num_samples: Candidates.
        action_noise: The standard deviation of the noise that is added after every step.
        optimizer_cls: `torch.optim.SGD` or `torch.optim.Adam`, or its name. For `None` it is Adam with a step of 0.1, or SGD
            if there are `optimizer_kwargs`.
        optimizer_kwargs: Arguments of the optimizer.
        grad_clip: The largest norm of a candidate's gradient.
        **settings: As for `CEMSolver`.

    Results of `solve` also have `cost`, `[[..]]`: the sum of the costs of all candidates in every step.
    """

    id = "gd"
    _descends = True
    _names: ClassVar[Mapping[str, str]] = {
        "num_samples": "samples",
        "n_steps": "iterations",
        "var_scale": "sigma",
        "grad_clip": "clip",
    }

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
        optimizer_cls: Any = None,
        optimizer_kwargs: Mapping[str, Any] | None = None,
        grad_clip: float | None = None,
        callbacks: Sequence[Callback] | None = None,
        **settings: Any,
    ) -> None:
        named: dict[str, Any] = {"n_steps": n_steps, "var_scale": var_scale, "num_samples": num_samples}
        named |= {"action_noise": action_noise, "grad_clip": grad_clip}
        if optimizer_cls is not None or optimizer_kwargs is not None:
            named["optimizer"] = optimizer(optimizer_cls or "sgd", optimizer_kwargs or {})
        super().__init__(cost, batch_size=batch_size, device=device, seed=seed, callbacks=callbacks, **{**named, **settings})
        self._given = {"optimizer_cls": optimizer_cls, "optimizer_kwargs": optimizer_kwargs}

    def _outputs(self, result: dict[str, Any], watched: Any) -> dict[str, Any]:
        return {"cost": summed_costs(result["trace"], self._all_settings()["samples"])}

    def init_action(self, n_envs: int, actions: Any = None) -> Any:
        """The plan that the candidates are drawn around, a tensor `(n_envs, horizon, action_dim)`."""
        return self._initial(n_envs, actions)
