"""Solvers, which search for action sequences of low cost.

    solver = swm.solver.CEMSolver(model, num_samples=300, n_steps=30, topk=30)
    policy = swm.policy.MPCPolicy(solver, config=swm.PlanConfig(horizon=5, receding_horizon=5))

`model` is any object with `get_cost` (a PyTorch module, a model of `swm.wm`, …), or `"simulator"`, which plans with the
environment itself. The search runs in the engine for all environments together; the plan of an environment depends on the
seed and the infos of that environment, not on other environments. A user-defined solver is any object with
`configure(action_space, n_envs, config)` and `solve(info_dict, init_action)`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np
from gymnasium import spaces

from . import _engine
from .planning import Adapter, has_torch

__all__ = [
    "AugmentedLagrangianSolver",
    "CEMSolver",
    "CategoricalCEMSolver",
    "GRASPSolver",
    "GradientSolver",
    "ICEMSolver",
    "LagrangianSolver",
    "MPPISolver",
    "PGDSolver",
    "PredictiveSamplingSolver",
    "Solver",
]


@runtime_checkable
class Solver(Protocol):
    """The interface that `MPCPolicy` requires of a solver."""

    def configure(self, *, action_space: spaces.Space, n_envs: int, config: Any) -> None:
        """Sets the batched action space, the number of environments and the `PlanConfig`."""
        ...

    def solve(self, info_dict: dict[str, Any], init_action: Any = None) -> dict[str, Any]:
        """Plans for every row of `info_dict` `(B, T, ..)`; returns a dict with `actions` `(B, horizon, action_dim)`."""
        ...


class EngineSolver:
    """Base class of the engine's solvers. Settings have the names that `swm solvers` lists, or the keys of `_names`."""

    #: The id of the solver in the engine.
    id: str
    #: The engine's names of settings, by their names in the constructor.
    _names: Mapping[str, str] = {}

    def __init__(
        self,
        model: Any = None,
        *,
        batch_size: int | None = None,
        device: Any = "cpu",
        seed: int = 1234,
        callbacks: Any = None,
        **settings: Any,
    ) -> None:
        if callbacks:
            raise TypeError(
                "callbacks: not supported, because the search runs outside of Python; read solve(…)['trace'] or policy.plans"
            )
        self.model, self.batch_size, self.device, self.seed = model, batch_size, device, int(seed)
        known = json.loads(_engine.solvers())[self.id]
        self.settings: dict[str, Any] = {}
        for name, value in settings.items():
            engine = self._names.get(name, name)
            if engine not in known:
                names = sorted({*self._names, *known} - set(self._names.values()))
                raise TypeError(f"{type(self).__name__} has no setting {name!r}; it has {', '.join(names)}")
            self.settings[engine] = value
        self._solved = 0
        self._action_space: spaces.Space | None = None
        self._n_envs, self._config = 0, None

    def __repr__(self) -> str:
        words = [type(self.model).__name__, *(f"{name}={value!r}" for name, value in self.settings.items())]
        return f"{type(self).__name__}({', '.join(words)})"

    def configure(self, *, action_space: spaces.Space, n_envs: int, config: Any) -> None:
        """See `Solver.configure`."""
        self._action_space, self._n_envs, self._config = action_space, int(n_envs), config

    @property
    def n_envs(self) -> int:
        """The number of environments."""
        return self._n_envs

    @property
    def horizon(self) -> int:
        """The number of model steps in a plan."""
        return self._configured().horizon

    @property
    def action_dim(self) -> int:
        """The dimension of one model step."""
        return _dim(self._space(), self._configured().action_block)

    def adapter(self, process: Any = None, transform: Any = None, history: int = 1) -> Any:
        """The model for the engine: a checkpoint or an `Adapter`; `None` for the simulator."""
        if self.model is None:
            raise ValueError(f"{type(self).__name__} has no model to plan with: pass one, or 'simulator'")
        if isinstance(self.model, str):
            if self.model != "simulator":
                raise ValueError(f"model: {self.model!r}; load a checkpoint with swm.wm.load, or pass 'simulator'")
            return None
        engine = getattr(self.model, "_engine_model", None)
        if engine is not None:
            return engine
        return Adapter(self.model, self.device, self.batch_size, process, transform, history, self.action_dim)

    def solve(self, info_dict: dict[str, Any], init_action: Any = None) -> dict[str, Any]:
        """Plans for every row of `info_dict` `(B, T, ..)`.

        Each call uses new random numbers. The same sequence of calls with the same seed returns the same plans.

        Args:
            info_dict: Infos `(B, T, ..)`.
            init_action: The actions at which the search starts, `(B, at most horizon, action_dim)`, padded with zeros.

        Returns:
            A dict with `actions` `(B, horizon, action_dim)`, `costs` (for each environment, the cost of the cheapest
            candidate of the last iteration) and `trace` (the record of each search).
        """
        config, space = self._configured(), self._space()
        block, horizon, dim = config.action_block, config.horizon, self.action_dim
        model = self.adapter()
        if model is None:
            raise ValueError("solve: the simulator needs the environments, and solve gets infos only; use MPCPolicy")
        infos = {key: value for key, value in info_dict.items() if not isinstance(value, (list, str))}
        envs = len(next(iter(infos.values())))
        if isinstance(model, Adapter):
            model.set_infos(infos)
            engine_infos: dict[str, Any] = {}
        else:
            engine_infos = {key: last_step(value) for key, value in infos.items()}
        low, high, choices = _bounds(space, block, model)
        init = None if init_action is None else _padded(init_action, envs, horizon, dim)
        actions, costs, trace = _engine.solve(
            self.id,
            json.dumps(self.settings),
            _Observed(model) if isinstance(model, Adapter) else model,
            engine_infos,
            envs,
            horizon,
            low,
            high,
            choices,
            init,
            self.seed,
            self._solved,
        )
        self._solved += 1
        found: Any = actions
        if has_torch():
            import torch

            found = torch.from_numpy(actions)
        return {"actions": found, "costs": costs.tolist(), "trace": json.loads(trace)}

    def __call__(self, info_dict: dict[str, Any], init_action: Any = None) -> dict[str, Any]:
        """The same as `solve`."""
        return self.solve(info_dict, init_action)

    def _configured(self) -> Any:
        if self._config is None:
            raise RuntimeError(f"{type(self).__name__}: call configure(action_space=…, n_envs=…, config=…) first")
        return self._config

    def _space(self) -> spaces.Space:
        self._configured()
        return single(self._action_space, self._n_envs)


class _Observed:
    """An adapter whose infos are set already, so `observe` does nothing."""

    def __init__(self, adapter: Adapter) -> None:
        self._adapter = adapter

    def observe(self, infos: Any) -> None:
        pass

    def __getattr__(self, name: str) -> Any:
        return getattr(self._adapter, name)


def single(space: Any, envs: int) -> Any:
    """The action space of one environment, given that space or the batched space of `envs` environments.

    A `MultiDiscrete` of `envs` equal sizes is taken as the batched space of a `Discrete`, as Gymnasium defines it.
    """
    if isinstance(space, spaces.Box) and len(space.shape) > 1:
        return spaces.Box(space.low[0], space.high[0], dtype=space.dtype.type)
    if isinstance(space, spaces.MultiDiscrete) and space.nvec.ndim > 1:
        return spaces.MultiDiscrete(space.nvec[0])
    if isinstance(space, spaces.MultiDiscrete) and len(space.nvec) == envs and (space.nvec == space.nvec[0]).all():
        return spaces.Discrete(space.nvec[0], start=space.start[0])
    return space


def last_step(value: Any) -> np.ndarray:
    """The last step `(B, ..)` of an info column `(B, T, ..)`, in a type that the engine supports."""
    if hasattr(value, "detach"):
        value = value.detach().cpu().numpy()
    value = np.asarray(value)
    value = value[:, -1] if value.ndim > 1 else value
    kinds = {"float16": np.float32, "int8": np.int32, "int16": np.int32, "uint16": np.int32, "uint32": np.int64}
    return np.ascontiguousarray(value, dtype=kinds.get(value.dtype.name, value.dtype))


def _dim(space: spaces.Space, block: int) -> int:
    """The dimension of a model step of `block` actions, with one-hot vectors for discrete choices."""
    if isinstance(space, spaces.Discrete):
        return int(space.n) * block
    if isinstance(space, spaces.MultiDiscrete):
        return int(space.nvec.sum()) * block
    return int(np.prod(space.shape or ())) * block


def _bounds(space: Any, block: int, model: Any) -> tuple[list[float], list[float], list[int] | None]:
    """The bounds of a model step in the model's units, or the sizes of its discrete choices."""
    if isinstance(space, spaces.Discrete):
        return [], [], [int(space.n)] * block
    if isinstance(space, spaces.MultiDiscrete):
        return [], [], [int(n) for n in space.nvec.reshape(-1)] * block
    low, high = (np.asarray(side, dtype=np.float32).reshape(-1) for side in (space.low, space.high))
    info = getattr(model, "info", None)
    if info is not None:
        info = json.loads(info)
        mean, std = (np.asarray(info[name], dtype=np.float32) for name in ("action_mean", "action_std"))
        low, high = (low - mean) / std, (high - mean) / std
    return np.tile(low, block).tolist(), np.tile(high, block).tolist(), None


def _padded(init: Any, envs: int, horizon: int, dim: int) -> np.ndarray:
    """The initial actions, padded with zeros to `(envs, horizon, dim)`."""
    init = np.asarray(init.detach().cpu() if hasattr(init, "detach") else init, dtype=np.float32)
    if init.ndim != 3 or init.shape[0] != envs or init.shape[1] > horizon or init.shape[2] != dim:
        raise ValueError(f"init_action: got shape {init.shape}, expected ({envs}, at most {horizon}, {dim})")
    return np.concatenate([init, np.zeros((envs, horizon - init.shape[1], dim), np.float32)], 1)


_SAMPLING = {"num_samples": "samples", "n_steps": "iterations", "topk": "elites", "var_scale": "sigma"}


class PredictiveSamplingSolver(EngineSolver):
    """Predictive sampling: samples candidates once and returns the cheapest one."""

    id = "predictive_sampling"
    _names = {"num_samples": "samples", "noise_scale": "sigma"}


class CEMSolver(EngineSolver):
    """Cross-entropy method: refits a Gaussian to the cheapest samples."""

    id = "cem"
    _names = _SAMPLING


class ICEMSolver(EngineSolver):
    """iCEM: CEM with coloured noise, elites carried over between iterations, and momentum."""

    id = "icem"
    _names = {**_SAMPLING, "noise_beta": "beta", "alpha": "momentum", "n_elite_keep": "keep"}


class MPPISolver(EngineSolver):
    """Model predictive path integral: moves the mean to the average of the samples, weighted by their costs."""

    id = "mppi"
    _names = _SAMPLING


class CategoricalCEMSolver(EngineSolver):
    """CEM for discrete actions: refits the probability of every option."""

    id = "categorical_cem"
    _names = {"num_samples": "samples", "n_steps": "iterations", "topk": "elites", "alpha": "momentum"}


_GRADIENT = {"num_samples": "samples", "n_steps": "iterations", "var_scale": "sigma"}


class _Gradient(EngineSolver):
    """Base class of gradient solvers, with `optimizer_cls` (a class of `torch.optim` or its name) and `optimizer_kwargs`."""

    _optimizer: str

    def __init__(
        self,
        model: Any = None,
        *,
        optimizer_cls: Any = None,
        optimizer_kwargs: Mapping[str, Any] | None = None,
        **settings: Any,
    ) -> None:
        if optimizer_cls is not None or optimizer_kwargs is not None:
            settings["optimizer"] = optimizer(optimizer_cls or self._optimizer, optimizer_kwargs or {})
        super().__init__(model, **settings)


def optimizer(kind: Any, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The engine's setting for an optimizer of torch."""
    kind = (kind if isinstance(kind, str) else kind.__name__).lower()
    if kind not in ("sgd", "adam"):
        raise ValueError(f"optimizer_cls: expected SGD or Adam, got {kind}")
    given = dict(settings)
    out: dict[str, Any] = {"kind": kind, "step": float(given.pop("lr", 1.0 if kind == "sgd" else 1e-3))}
    if kind == "adam":
        betas = given.pop("betas", (0.9, 0.999))
        out |= {"beta1": float(betas[0]), "beta2": float(betas[1]), "epsilon": float(given.pop("eps", 1e-8))}
    if given:
        raise ValueError(f"optimizer_kwargs: the engine's {kind} does not support {', '.join(given)}; remove them")
    return out


class GradientSolver(_Gradient):
    """Gradient descent on the cost from several initial action sequences."""

    id = "gd"
    _names = {**_GRADIENT, "grad_clip": "clip"}
    _optimizer = "sgd"


class PGDSolver(EngineSolver):
    """Projected gradient descent for discrete actions, on the probabilities of the options."""

    id = "pgd"
    _names = _GRADIENT


class LagrangianSolver(_Gradient):
    """Augmented Lagrangian: gradient descent with a growing penalty on violated constraints (`get_constraints`)."""

    id = "lagrangian"
    _names = {
        **_GRADIENT,
        "n_outer_steps": "outer_iterations",
        "rho_init": "penalty",
        "rho_max": "penalty_limit",
        "rho_scale": "penalty_growth",
    }
    _optimizer = "adam"


AugmentedLagrangianSolver = LagrangianSolver


class GRASPSolver(EngineSolver):
    """GRASP: optimises states and actions of all model steps in parallel; the model is a `planning.Dynamics`."""

    id = "grasp"
    _names = {"n_steps": "iterations"}
