"""Solvers: who finds cheap action sequences.

    solver = swm.solver.CEMSolver(model, num_samples=300, n_steps=30, topk=30)
    policy = swm.policy.MPCPolicy(solver, config=swm.PlanConfig(horizon=5, receding_horizon=5))

`model` is anything with `get_cost` (a PyTorch module, one of `swm.wm`, …), or `"simulator"`: the world itself, the upper bound
of any model. The search runs in the engine, for all
environments together; what it returns depends on the seed and on each environment's own infos, never on how many are
planned together. A solver of one's own is any object with `configure(action_space, n_envs, config)` and
`solve(info_dict, init_action)`.
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
    """What a policy needs of a solver."""

    def configure(self, *, action_space: spaces.Space, n_envs: int, config: Any) -> None:
        """Tells the action space (of all environments together), how many there are, and the `PlanConfig`."""
        ...

    def solve(self, info_dict: dict[str, Any], init_action: Any = None) -> dict[str, Any]:
        """Plans for every row of `info_dict` `(B, T, ..)`: a dict with `actions` `(B, horizon, action_dim)`."""
        ...


class EngineSolver:
    """A solver of the engine. Its settings have the names they have in `swm solvers`, beside those of the constructor."""

    #: Its id in the engine.
    id: str
    #: What the constructor calls a setting of the engine.
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
            raise TypeError("callbacks: the search runs outside of Python; solve(…)['trace'] and policy.plans tell how it went")
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
        """Environments that are planned for."""
        return self._n_envs

    @property
    def horizon(self) -> int:
        """Model steps of a plan."""
        return self._configured().horizon

    @property
    def action_dim(self) -> int:
        """Numbers of one model step."""
        return _dim(self._space(), self._configured().action_block)

    def adapter(self, process: Any = None, transform: Any = None, history: int = 1) -> Any:
        """The model as the engine asks it; `None` for the world itself."""
        if self.model is None:
            raise ValueError(f"{type(self).__name__} was made without a model to plan in: give it one, or 'simulator'")
        if isinstance(self.model, str):
            if self.model != "simulator":
                raise ValueError(f"model: {self.model!r}; load a checkpoint with swm.wm.load, or say 'simulator'")
            return None
        engine = getattr(self.model, "_engine_model", None)
        if engine is not None:
            return engine
        return Adapter(self.model, self.device, self.batch_size, process, transform, history, self.action_dim)

    def solve(self, info_dict: dict[str, Any], init_action: Any = None) -> dict[str, Any]:
        """Plans for every row of `info_dict` `(B, T, ..)`.

        Returns a dict with `actions` `(B, horizon, action_dim)`, `costs` (one an environment: of the cheapest candidate
        of the last iteration) and `trace` (how each search went). Every call draws other random numbers; the same calls
        with the same seed draw the same.
        """
        config, space = self._configured(), self._space()
        block, horizon, dim = config.action_block, config.horizon, self.action_dim
        model = self.adapter()
        if model is None:
            raise ValueError("the simulator is planned in by MPCPolicy, which sees the worlds themselves; solve sees infos")
        infos = {key: value for key, value in info_dict.items() if not isinstance(value, (list, str))}
        envs = len(next(iter(infos.values())))
        if isinstance(model, Adapter):
            model.see(infos)
            engine_infos: dict[str, Any] = {}
        else:
            engine_infos = {key: now(value) for key, value in infos.items()}
        low, high, choices = _bounds(space, block, model)
        init = None if init_action is None else _padded(init_action, envs, horizon, dim)
        actions, costs, trace = _engine.solve(
            self.id,
            json.dumps(self.settings),
            _Seen(model) if isinstance(model, Adapter) else model,
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


class _Seen:
    """An adapter that has seen its infos already."""

    def __init__(self, adapter: Adapter) -> None:
        self._adapter = adapter

    def observe(self, infos: Any) -> None:
        pass

    def __getattr__(self, name: str) -> Any:
        return getattr(self._adapter, name)


def single(space: Any, envs: int) -> Any:
    """The action space of one environment, of that of one or of all `envs` together.

    Several choices, as many as there are environments and all of one kind, are taken for one an environment: that is what
    Gymnasium makes of `Discrete`.
    """
    if isinstance(space, spaces.Box) and len(space.shape) > 1:
        return spaces.Box(space.low[0], space.high[0], dtype=space.dtype.type)
    if isinstance(space, spaces.MultiDiscrete) and space.nvec.ndim > 1:
        return spaces.MultiDiscrete(space.nvec[0])
    if isinstance(space, spaces.MultiDiscrete) and len(space.nvec) == envs and (space.nvec == space.nvec[0]).all():
        return spaces.Discrete(space.nvec[0], start=space.start[0])
    return space


def now(value: Any) -> np.ndarray:
    """A column `(B, T, ..)` of infos as the engine takes it: the latest moment `(B, ..)`."""
    if hasattr(value, "detach"):
        value = value.detach().cpu().numpy()
    value = np.asarray(value)
    value = value[:, -1] if value.ndim > 1 else value
    kinds = {"float16": np.float32, "int8": np.int32, "int16": np.int32, "uint16": np.int32, "uint32": np.int64}
    return np.ascontiguousarray(value, dtype=kinds.get(value.dtype.name, value.dtype))


def _dim(space: spaces.Space, block: int) -> int:
    if isinstance(space, spaces.Discrete):
        return int(space.n) * block
    if isinstance(space, spaces.MultiDiscrete):
        return int(space.nvec.sum()) * block
    return int(np.prod(space.shape or ())) * block


def _bounds(space: Any, block: int, model: Any) -> tuple[list[float], list[float], list[int] | None]:
    """What a model step may be, in the model's units."""
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
    init = np.asarray(init.detach().cpu() if hasattr(init, "detach") else init, dtype=np.float32)
    if init.ndim != 3 or init.shape[0] != envs or init.shape[1] > horizon or init.shape[2] != dim:
        raise ValueError(f"init_action: got shape {init.shape}, expected ({envs}, at most {horizon}, {dim})")
    return np.concatenate([init, np.zeros((envs, horizon - init.shape[1], dim), np.float32)], 1)


_SAMPLING = {"num_samples": "samples", "n_steps": "iterations", "topk": "elites", "var_scale": "sigma"}


class PredictiveSamplingSolver(EngineSolver):
    """Tries many guesses once and takes the cheapest."""

    id = "predictive_sampling"
    _names = {"num_samples": "samples", "noise_scale": "sigma"}


class CEMSolver(EngineSolver):
    """Cross-entropy method: refits a Gaussian to the cheapest samples."""

    id = "cem"
    _names = _SAMPLING


class ICEMSolver(EngineSolver):
    """CEM with coloured noise, kept elites and momentum."""

    id = "icem"
    _names = {**_SAMPLING, "noise_beta": "beta", "alpha": "momentum", "n_elite_keep": "keep"}


class MPPISolver(EngineSolver):
    """Model predictive path integral: moves a mean by the weights that samples get from their costs."""

    id = "mppi"
    _names = _SAMPLING


class CategoricalCEMSolver(EngineSolver):
    """CEM for discrete actions: refits the probability of every option."""

    id = "categorical_cem"
    _names = {"num_samples": "samples", "n_steps": "iterations", "topk": "elites", "alpha": "momentum"}


_GRADIENT = {"num_samples": "samples", "n_steps": "iterations", "var_scale": "sigma", "grad_clip": "clip"}


class _Gradient(EngineSolver):
    """What gradient solvers share: `optimizer_cls` (a class of `torch.optim` or its name) and `optimizer_kwargs`."""

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
    """An optimizer of torch's, as the engine calls it."""
    kind = (kind if isinstance(kind, str) else kind.__name__).lower()
    if kind not in ("sgd", "adam"):
        raise ValueError(f"optimizer_cls: the engine has SGD and Adam, not {kind}")
    given = dict(settings)
    out: dict[str, Any] = {"kind": kind, "step": float(given.pop("lr", 1.0 if kind == "sgd" else 1e-3))}
    if kind == "adam":
        betas = given.pop("betas", (0.9, 0.999))
        out |= {"beta1": float(betas[0]), "beta2": float(betas[1]), "epsilon": float(given.pop("eps", 1e-8))}
    if given:
        raise ValueError(f"optimizer_kwargs: the engine's {kind} has no {', '.join(given)}")
    return out


class GradientSolver(_Gradient):
    """Follows the gradient of the cost from several starts."""

    id = "gd"
    _names = _GRADIENT
    _optimizer = "sgd"


class PGDSolver(EngineSolver):
    """Projected gradient descent for discrete actions: on probabilities of the options."""

    id = "pgd"
    _names = _GRADIENT


class LagrangianSolver(_Gradient):
    """Augmented Lagrangian: follows the gradient and prices violated constraints (`get_constraints`) ever higher."""

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
    """Optimises states and actions together, every model step by itself; the model is a `planning.Dynamics`."""

    id = "grasp"
    _names = {"n_steps": "iterations"}
