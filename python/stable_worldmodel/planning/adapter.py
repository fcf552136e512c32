"""The adapter through which the engine calls models implemented in Python."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import numpy as np

from .latent import LatentCost, LatentDynamics

__all__ = ["Adapter", "has_torch", "prepared"]


def _torch() -> Any:
    import torch

    return torch


@lru_cache(maxsize=1)
def has_torch() -> bool:
    """Whether torch is installed."""
    return importlib.util.find_spec("torch") is not None


def prepared(info: Mapping[str, Any], process: Mapping[str, Any], transform: Mapping[str, Any]) -> dict[str, Any]:
    """Infos `(B, T, ..)` scaled by `process` and transformed by `transform`, as torch tensors if torch is installed.

    A transform is called with one frame `(C, H, W)` at a time, a torch tensor.
    """
    out: dict[str, Any] = {}
    for key, value in info.items():
        if key in process:
            array = np.asarray(value)
            flat = array.reshape(-1, *array.shape[2:]) if array.ndim > 2 else array
            value = np.asarray(process[key].transform(flat)).reshape(array.shape)
        if key in transform:
            torch = _torch()
            frames = torch.as_tensor(np.asarray(value))
            shape = frames.shape[:2]
            frames = frames.reshape(-1, *frames.shape[2:])
            if frames.ndim == 4 and frames.shape[-1] == 3:
                frames = frames.permute(0, 3, 1, 2)
            frames = torch.stack([transform[key](frame) for frame in frames])
            value = frames.reshape(*shape, *frames.shape[1:])
        if has_torch() and isinstance(value, np.ndarray) and value.dtype.kind in "bifu":
            value = _torch().from_numpy(np.ascontiguousarray(value))
        out[key] = value
    return out


class CostError(ValueError, AssertionError):
    """A model returned costs of another shape, or complex ones."""


class Adapter:
    """A Python model for the engine, with numpy arrays as arguments and results.

    Args:
        model: A `Costable`, or `LatentDynamics`.
        device: The device of torch tensors.
        batch_size: The number of environments in one call of the model; all environments for `None`. The batch
            size does not affect the result.
        process, transform: As for `stable_worldmodel.policy.MPCPolicy`.
        history: The number of frames that the model gets, including the current frame.
        dim: The dimension of one model step.
    """

    def __init__(
        self,
        model: Any,
        device: Any = "cpu",
        batch_size: int | None = None,
        process: Mapping[str, Any] | None = None,
        transform: Mapping[str, Any] | None = None,
        history: int = 1,
        dim: int = 0,
    ) -> None:
        if not hasattr(model, "get_cost") and isinstance(model, LatentDynamics):
            model = LatentCost(model)
        if not callable(getattr(model, "get_cost", None)):
            raise TypeError(f"{type(model).__name__} cannot be planned with: expected get_cost(info_dict, action_candidates)")
        if batch_size is not None and batch_size < 1:
            raise ValueError(f"batch_size: {batch_size}; expected at least 1, or None for all environments at once")
        self.model, self.device, self.batch_size = model, device, batch_size
        self.process, self.transform = process or {}, transform or {}
        self.history, self.dim = history, dim
        self.torch = has_torch() and getattr(model, "backend", "torch") != "numpy"
        #: The modules of the model that are in training mode outside of its calls.
        self._training: list[Any] = []
        self.dtype = self._dtype()
        #: Whether tensors of the model are float32 on the CPU, as the engine's arrays are.
        self._as_engine = self.torch and _torch().device(device).type == "cpu" and self.dtype == _torch().float32
        self._infos: dict[str, Any] = {}
        self._envs = 0
        self._expanded_infos: dict[Any, dict[str, Any]] = {}
        self._constraints: dict[int, int] = {}

    def _dtype(self) -> Any:
        if not self.torch:
            return None
        try:
            return next(self.model.parameters()).dtype
        except (AttributeError, StopIteration, TypeError):
            return _torch().float32

    # Read by the engine before it plans.

    @property
    def has_gradient(self) -> bool:
        """Whether the model supports gradients."""
        return self.torch

    @property
    def has_constraints(self) -> bool:
        """Whether the model has `get_constraints`."""
        return hasattr(self.model, "get_constraints")

    @property
    def dynamics(self) -> Any:
        """The `LatentDynamics` of the model; `None` if it has none."""
        inner = getattr(self.model, "dynamics", self.model)
        return inner if isinstance(inner, LatentDynamics) else None

    @property
    def latent_dim(self) -> int | None:
        """The latent dimension; `None` if the model has no `LatentDynamics`."""
        dynamics = self.dynamics
        if dynamics is None or not self.torch:
            return None
        dim = getattr(dynamics, "latent_dim", None)
        if dim is None:
            raise AttributeError(f"{type(dynamics).__name__} has encode and predict but no latent_dim: add the attribute")
        return int(dim)

    # Called by the engine while it plans.

    def observe(self, infos: Mapping[str, np.ndarray]) -> None:
        """Sets the infos of the current step, `(B, ..)`, and the history that the infos contain."""
        timed = {key: value[:, None] for key, value in infos.items() if not key.startswith("history.")}
        if self.history > 1 and "history.pixels" in infos and "pixels" in timed:
            past = infos["history.pixels"]
            # Before the first step, the history repeats the first frame.
            lengths = infos["history.length"].reshape(-1)
            steps = past.shape[1]
            for row, length in enumerate(lengths):
                missing = steps - min(int(length), steps)
                if missing:
                    past[row, :missing] = past[row, missing] if missing < steps else timed["pixels"][row, 0]
            timed["pixels"] = np.concatenate([past, timed["pixels"]], 1)
            timed["history_action"] = timed["action_history"] = infos["history.action"]
        self.set_infos(timed)

    def set_infos(self, infos: Mapping[str, Any], envs: int | None = None) -> None:
        """Sets the infos `(B, T, ..)`: tensors, arrays, or lists and texts, which the model gets as they are.

        Args:
            infos: The infos.
            envs: The number of environments, B; that of the first entry for `None`.
        """
        self._infos = prepared(infos, self.process, self.transform)
        is_module = self.torch and isinstance(self.model, _torch().nn.Module)
        self._training = [module for module in self.model.modules() if module.training] if is_module else []
        self._envs = len(next(iter(self._infos.values()))) if envs is None else envs
        self._expanded_infos.clear()

    @contextmanager
    def _evaluating(self) -> Iterator[None]:
        """The model in evaluation mode for a call."""
        if self._training:
            self.model.eval()
        try:
            yield
        finally:
            for module in self._training:
                module.training = True

    def cost(self, candidates: np.ndarray) -> np.ndarray:
        """The costs `(B, S)` of candidates `(B, S, H, A)`."""
        if not self.torch:
            # A model may write the costs of the next environments over these.
            costs = np.concatenate([self._own_costs(*part) for part in self._parts(candidates, "cost")])
            self._check_real(costs)
            return np.ascontiguousarray(costs, dtype=np.float32)
        if not _torch().is_inference_mode_enabled():
            with _torch().inference_mode():
                return self.cost(candidates)
        parts = self._parts(candidates, "cost")
        with self._evaluating():
            if len(parts) == 1:
                return self._numpy([self._cost(*parts[0])])
            # A model may write the costs of the next environments over these, so each is copied before the next.
            return np.concatenate([self._numpy([self._cost(infos, part)]).copy() for infos, part in parts])

    def _own_costs(self, infos: dict[str, Any], candidates: Any) -> np.ndarray:
        costs = self.model.get_cost(infos, candidates)
        if np.ma.is_masked(costs):
            raise CostError(f"{type(self.model).__name__}.get_cost: expected costs without masked values, got {costs}")
        return np.array(costs)

    def cost_and_gradient(self, candidates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The costs `(B, S)` of candidates `(B, S, H, A)` and their gradients `(B, S, H, A)`."""
        torch = _torch()
        costs, gradients = [], []
        with self._evaluating(), torch.inference_mode(False), torch.enable_grad():
            for infos, part in self._parts(candidates, "gradient"):
                part = part.requires_grad_()
                cost = self._checked_cost(infos, part)
                if not cost.requires_grad:
                    name = type(self.model).__name__
                    raise ValueError(f"{name}.get_cost is not differentiable: its result does not depend on its actions")
                # The cost of a candidate depends on its own actions only, so the gradient of the sum holds all gradients.
                # Values that the model cached in its infos may belong to an older graph, so graphs are retained.
                (gradient,) = torch.autograd.grad(cost.sum(), part, retain_graph=True)
                costs.append(cost.detach().clone())
                gradients.append(gradient)
        return self._numpy(costs), self._numpy(gradients)

    def encode(self) -> tuple[np.ndarray, np.ndarray]:
        """The latents `(B, D)` of the current observation and of the goal."""
        dynamics = self.dynamics
        with self._evaluating(), _torch().inference_mode():
            infos = {key: self._on_device(value) for key, value in self._infos.items()}
            latents = [dynamics.encode(infos), dynamics.encode_goal(infos)]
            if not all(_torch().is_tensor(latent) for latent in latents):
                found = ", ".join(type(latent).__name__ for latent in latents)
                raise TypeError(
                    f"{type(dynamics).__name__}: encode and encode_goal give {found}; expected torch tensors, because this "
                    "solver follows the gradient of predict"
                )
            return self._numpy(latents[:1]), self._numpy(latents[1:])

    def predict(self, latents: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """The latents `(N, D)` one model step after `latents` `(N, D)` with actions `(N, A)`."""
        with self._evaluating(), _torch().inference_mode():
            return self._numpy([self.dynamics.predict(self._tensor(latents), self._tensor(actions))])

    def predict_vjp(self, latents: np.ndarray, actions: np.ndarray, gradient: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The vector-Jacobian products of a prediction, `(N, D)` and `(N, A)`, for the output gradient `gradient` `(N, D)`."""
        torch = _torch()
        with self._evaluating(), torch.inference_mode(False), torch.enable_grad():
            given = self._tensor(latents).requires_grad_(), self._tensor(actions).requires_grad_()
            predicted = self.dynamics.predict(*given)
            gradients = torch.autograd.grad(predicted, given, self._tensor(gradient), allow_unused=True)
        filled = [torch.zeros_like(x) if g is None else g for g, x in zip(gradients, given, strict=True)]
        return self._numpy(filled[:1]), self._numpy(filled[1:])

    def constraints(self, horizon: int) -> int:
        """The number of constraints of a candidate, as the model returns them for zero actions."""
        if horizon not in self._constraints:
            zeros = np.zeros((self._envs, 1, horizon, self.dim), dtype=np.float32)
            self._constraints[horizon] = self.constrain(zeros).shape[-1]
        return self._constraints[horizon]

    def constrain(self, candidates: np.ndarray) -> np.ndarray:
        """Constraint values `(B, S, C)`, satisfied when at most 0."""
        with self._evaluating(), _torch().inference_mode():
            parts = self._parts(candidates, "constrain")
            return self._numpy([self.model.get_constraints(infos, part).clone() for infos, part in parts])

    def constrain_vjp(self, candidates: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """The gradient of the constraints with respect to the candidates, weighted by `weights` `(B, S, C)`."""
        torch = _torch()
        gradients, at = [], 0
        with self._evaluating(), torch.inference_mode(False), torch.enable_grad():
            for infos, part in self._parts(candidates, "constrain gradient"):
                part = part.requires_grad_()
                values = self.model.get_constraints(infos, part)
                weight = self._tensor(weights[at : at + len(part)])
                at += len(part)
                (gradient,) = torch.autograd.grad(values, part, weight, retain_graph=True, allow_unused=True)
                gradients.append(torch.zeros_like(part) if gradient is None else gradient)
        return self._numpy(gradients)

    # Conversion between numpy and torch.

    def _cost(self, infos: dict[str, Any], candidates: Any) -> Any:
        """The costs of candidates on their device, recorded as CUDA graphs for models that allow it."""
        if self._as_engine or candidates.device.type != "cuda" or getattr(self.model, "prepare_plan", None) is None:
            return self._checked_cost(infos, candidates)
        from .capture import CapturedCosts

        return CapturedCosts.of(self.model)(self.model, infos, candidates, self._checked_cost)

    def _checked_cost(self, infos: dict[str, Any], candidates: Any) -> Any:
        cost = self.model.get_cost(infos, candidates)
        expected = candidates.shape[:2]
        if getattr(cost, "shape", None) != expected:
            got = tuple(cost.shape) if hasattr(cost, "shape") else type(cost).__name__
            name, expected = type(self.model).__name__, tuple(expected)
            raise CostError(f"{name}.get_cost: expected costs of shape {expected} (environments, candidates), got {got}")
        if not (self._as_engine and cost.dtype == self.dtype):
            self._check_real(cost)
        return cost if not isinstance(cost, np.ndarray) else _torch().from_numpy(cost)

    def _check_real(self, cost: Any) -> None:
        if np.iscomplexobj(cost) if isinstance(cost, np.ndarray) else cost.is_complex():
            raise CostError(f"{type(self.model).__name__}.get_cost: expected real costs, got {cost.dtype}")

    def _parts(self, candidates: np.ndarray, what: str) -> list[tuple[dict[str, Any], Any]]:
        """Pairs of infos, repeated for every candidate, and candidates, for `batch_size` environments at a time."""
        envs, samples = candidates.shape[:2]
        size = self.batch_size or envs
        parts = []
        for begin in range(0, envs, size):
            part = candidates if size >= envs else candidates[begin : begin + size]
            key = (what, begin, samples)
            infos = self._expanded_infos.get(key)
            if infos is None:
                infos = self._expanded_infos[key] = self._expanded(slice(begin, begin + len(part)), part)
            parts.append((infos, self._tensor(part) if self.torch else part))
        return parts

    def _expanded(self, rows: slice, part: np.ndarray) -> dict[str, Any]:
        samples, dim = part.shape[1], part.shape[3]
        infos: dict[str, Any] = {}
        for key, value in self._infos.items():
            if isinstance(value, np.ndarray):
                selected = value[rows][:, None]
                infos[key] = np.broadcast_to(selected, (selected.shape[0], samples, *selected.shape[2:]))
            elif hasattr(value, "expand"):
                selected = self._on_device(value[rows]).unsqueeze(1)
                infos[key] = selected.expand(-1, samples, *selected.shape[2:])
            else:
                infos[key] = value[rows] if isinstance(value, list) and len(value) == self._envs else value
        if "action" not in infos and self.torch:
            infos["action"] = self._tensor(np.zeros((part.shape[0], samples, 1, dim), dtype=np.float32))
        return infos

    def _on_device(self, value: Any) -> Any:
        """A tensor on the device, in the model's type if it is floating point; other values unchanged."""
        if not hasattr(value, "is_floating_point"):
            return value
        return value.to(device=self.device, dtype=self.dtype if value.is_floating_point() else None)

    def _tensor(self, array: np.ndarray) -> Any:
        tensor = _torch().from_numpy(array)
        return tensor if self._as_engine else tensor.to(device=self.device, dtype=self.dtype)

    def _numpy(self, tensors: Sequence[Any]) -> np.ndarray:
        joined = tensors[0] if len(tensors) == 1 else _torch().cat(list(tensors))
        if joined.requires_grad or not joined.is_cpu or joined.dtype != _torch().float32:
            joined = joined.detach().to("cpu", _torch().float32)
        return np.ascontiguousarray(joined.numpy())
