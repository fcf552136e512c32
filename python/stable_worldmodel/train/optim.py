"""`Optimizer`: AdamW with the engine's parameter groups, whose state a checkpoint holds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

__all__ = ["Optimizer", "learning_rate"]


class Optimizer:
    """AdamW, with a clipping group and a factor of the learning rate for each parameter.

    Args:
        model: The module, of a checkpoint of the engine.
        groups: The clipping group and the factor of each weight, by the name in the checkpoint.
        settings: The table `optim` of the configuration.
    """

    def __init__(self, model: Any, groups: Mapping[str, Sequence[float]], settings: Mapping[str, Any]) -> None:
        self.settings = settings
        #: The trained parameters, by the name in the checkpoint.
        self.parameters: dict[str, nn.Parameter] = {}
        #: The parameters of each clipping group.
        self.clipped: dict[float, list[nn.Parameter]] = {}
        by_rate: dict[float, list[nn.Parameter]] = {}
        for name, parameter in model.named_parameters():
            if not parameter.requires_grad:
                continue
            name = model._checkpoint_name(name)
            clip, rate = groups[name]
            self.parameters[name] = parameter
            self.clipped.setdefault(clip, []).append(parameter)
            by_rate.setdefault(rate, []).append(parameter)
        #: The name of the smallest trained parameter.
        self._smallest = min(self.parameters, key=lambda name: (self.parameters[name].numel(), name))
        #: Whether a GPU updates all weights with one kernel, which counts steps on the GPU.
        self._fused = all(parameter.is_cuda for parameter in self.parameters.values())
        self.adam = torch.optim.AdamW(
            [{"params": parameters, "rate": rate} for rate, parameters in by_rate.items()],
            lr=settings["lr"],
            betas=tuple(settings["betas"]),
            eps=settings["epsilon"],
            weight_decay=settings["weight_decay"],
            fused=self._fused,
        )

    def zero_grad(self) -> None:
        """Removes gradients."""
        self.adam.zero_grad(set_to_none=True)

    def step(self, done: int, factor: float, scaler: Any) -> float:
        """Makes a step at `factor` times the peak learning rate, and returns the norm of the gradient before clipping.

        Args:
            done: The number of steps before this one.
            factor: The factor of the learning rate.
            scaler: The scaler of the loss in half precision.

        Raises:
            FloatingPointError: If the norm is not finite. In half precision, the step is left out instead.
        """
        for group in self.adam.param_groups:
            group["lr"] = self.settings["lr"] * factor * group["rate"]
        scaler.unscale_(self.adam)
        norms = [float(nn.utils.clip_grad_norm_(group, self.settings["clip"])) for group in self.clipped.values()]
        norm = math.hypot(*norms)
        # Clipping scales finite gradients of infinite norm to 0, so that the training would go on and learn nothing.
        if not scaler.is_enabled() and not math.isfinite(norm):
            raise FloatingPointError(
                f"the norm of the gradient at training step {done + 1} is {norm}; lower optim.lr or the weights of the loss, "
                "or lengthen schedule.warmup; the last checkpoint is kept"
            )
        scaler.step(self.adam)
        scaler.update()
        return norm

    def moments(self, done: int, scaler: Any) -> dict[str, Tensor]:
        """The state, as a checkpoint holds it: `first.NAME` and `second.NAME`, flattened.

        A training in half precision also has the scale of its loss (`scale.NAME`), the steps since the scale changed
        (`growth.NAME`), and, as some steps are left out, the number of the others (`steps.NAME`).

        Args:
            done: The number of steps of the training.
            scaler: The scaler of the loss in half precision.
        """
        found = {}
        for name, parameter in self.parameters.items():
            state = self.adam.state.get(parameter)
            if state:
                found[f"first.{name}"] = state["exp_avg"].flatten()
                found[f"second.{name}"] = state["exp_avg_sq"].flatten()
        values = {}
        if (steps := max((float(state["step"]) for state in self.adam.state.values()), default=0.0)) != done:
            values["steps"] = steps
        if scaler.is_enabled():
            state = scaler.state_dict()
            values |= {"scale": float(state["scale"]), "growth": float(state["_growth_tracker"])}
        # The engine continues runs whose tensors have the sizes of weights, so the value is repeated for the smallest one.
        size = self.parameters[self._smallest].numel()
        # Not of torch's default type, which a program can set to one that rounds the number of steps.
        repeated = {part: torch.full((size,), value, dtype=torch.float32) for part, value in values.items()}
        return found | {f"{part}.{self._smallest}": tensor for part, tensor in repeated.items()}

    def restore(self, done: int, moments: Mapping[str, Tensor], scaler: Any) -> None:
        """Restores the state of `moments`, and that of the scaler if it is in use."""
        values = {
            part: float(moments[key][0])
            for part in ("steps", "scale", "growth")
            if (key := f"{part}.{self._smallest}") in moments
        }
        if scaler.is_enabled() and "scale" in values:
            state = {"scale": values["scale"], "_growth_tracker": int(values["growth"])}
            scaler.load_state_dict({**scaler.state_dict(), **state})
        steps = values.get("steps", float(done))
        for name, parameter in self.parameters.items():
            if f"first.{name}" in moments:
                first, second = (moments[f"{part}.{name}"].view_as(parameter) for part in ("first", "second"))
                self.adam.state[parameter] = {
                    "step": torch.tensor(steps, device=parameter.device if self._fused else "cpu"),
                    "exp_avg": first.to(parameter),
                    "exp_avg_sq": second.to(parameter),
                }


def learning_rate(schedule: Mapping[str, Any], step: int) -> float:
    """The factor of the peak learning rate at a step: linear warm-up, then cosine decay to the floor."""
    warmup, floor = schedule["warmup"], schedule["floor"]
    if step < warmup:
        return (step + 1) / warmup  # type: ignore[no-any-return]
    progress = min((step - warmup) / max(schedule["steps"] - warmup, 1), 1.0)
    return floor + (1 - floor) * 0.5 * (1 + math.cos(math.pi * progress))  # type: ignore[no-any-return]
