"""`EngineSolver`: the base class of the solvers of the engine."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from contextvars import ContextVar
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from ... import _engine, _options
from ..._action_spaces import single
from ..._forks import fork_lock
from ..._overrides import engine_part
from ...data import _tensors
from ..adapter import Adapter
from .callbacks import Callback
from .hooks import Observer, Watched, view

__all__ = ["EngineSolver", "NotConfigured", "last_step", "summed_costs"]


#: The episode's key and the number of the plan, for each row of the next call of `solve`: see `MPCPolicy`.
PLANS: ContextVar[list[tuple[int, int]] | None] = ContextVar("PLANS", default=None)

#: The scaler between the units of the next call's plans and those of the environment: see `MPCPolicy`.
ACTION_SCALER: ContextVar[Any] = ContextVar("ACTION_SCALER", default=None)

#: Held while a call of `solve` takes its number; not by the solvers, because locks cannot be pickled.
_COUNTING = fork_lock()


class NotConfigured(RuntimeError, AttributeError):
    """A property of a solver that `configure` sets was read before."""


@lru_cache(maxsize=1)
def _defaults() -> dict[str, dict[str, Any]]:
    """The settings of the engine's solvers with their defaults, by the id of the solver. Do not change it."""
    return json.loads(_engine.solvers())  # type: ignore[no-any-return]


class EngineSolver:
    """Base class of the engine's solvers. Settings have the names that `swm solvers` lists, or the keys of `_names`."""

    #: The id of the solver in the engine.
    id: ClassVar[str]
    #: The engine's names of settings, by their names in the constructor.
    _names: ClassVar[Mapping[str, str]] = {}
    #: Whether the solver follows a gradient.
    _descends: ClassVar[bool] = False

    def __init__(
        self,
        cost: Any = None,
        *,
        model: Any = None,
        batch_size: int | None = None,
        device: Any = "cpu",
        seed: int = 1234,
        callbacks: Sequence[Callback] | None = None,
        **settings: Any,
    ) -> None:
        if cost is not None and model is not None:
            raise TypeError(f"{type(self).__name__}: cost and model are two names of the same argument; give one")
        model = cost if model is None else model
        #: The callbacks, which run after every iteration.
        self.callbacks = list(callbacks or ())
        self.model, self.device = model, device
        self.batch_size = None if batch_size is None else _options.count("batch_size", batch_size)
        self.seed = _options.count("seed", seed, least=0)
        known = _defaults()[self.id]
        self.settings: dict[str, Any] = {}
        #: Arguments of the constructor that are no settings of the engine.
        self._given: dict[str, Any] = {}
        for name, value in settings.items():
            engine = self._names.get(name, name)
            if engine not in known:
                names = sorted({*self._names, *known} - set(self._names.values()))
                raise TypeError(f"{type(self).__name__} has no setting {name!r}; it has {', '.join(names)}")
            self.settings[engine] = _plain(f"{type(self).__name__}: {name}", value)
        self._solved = 0
        self._action_space: spaces.Space[Any] | None = None
        #: The action space of one environment; `None` until it is asked for.
        self._single: spaces.Space[Any] | None = None
        self._n_envs, self._config = 0, None

    def __repr__(self) -> str:
        words = [type(self.model).__name__, *(f"{name}={value!r}" for name, value in self.settings.items())]
        return f"{type(self).__name__}({', '.join(words)})"

    def configure(self, *, action_space: spaces.Space[Any], n_envs: int, config: Any) -> None:
        """See `Solver.configure`."""
        sizes = {name: getattr(config, name, 1) for name in ("horizon", "action_block", "history_len")}
        # Only policies read the history, and a config of the user may have none.
        sizes["history_len"] = sizes["history_len"] or 1
        _engine.check_plan(*(_options.count(f"config.{name}", size) for name, size in sizes.items()))
        self._action_space, self._n_envs, self._config = action_space, int(n_envs), config
        self._single = None

    @property
    def cost(self) -> Any:
        """The model, as the constructor's argument is named."""
        return self.model

    @property
    def dtype(self) -> Any:
        """The type of the model's parameters; float32 for a model without parameters."""
        import torch

        parameters = getattr(self.model, "parameters", None)
        first = next(iter(parameters()), None) if callable(parameters) else None
        return torch.float32 if first is None else first.dtype

    @property
    def n_envs(self) -> int:
        """The number of environments."""
        self._configured()
        return self._n_envs

    @property
    def horizon(self) -> int:
        """The number of model steps in a plan."""
        return int(self._configured().horizon)

    @property
    def action_dim(self) -> int:
        """The dimension of one model step."""
        return self._plan_dim

    @property
    def _plan_dim(self) -> int:
        """The dimension of one model step in the engine, with one-hot vectors for discrete choices."""
        return _dim(self._space(), self._configured().action_block)

    def adapter(self, process: Any = None, transform: Any = None, history: int = 1) -> Any:
        """The model for the engine: a checkpoint or an `Adapter`; `None` for the simulator."""
        if self.model is None:
            raise ValueError(f"{type(self).__name__} has no model to plan with: pass one, or 'simulator'")
        if isinstance(self.model, str):
            if self.model != "simulator":
                raise ValueError(f"model: {self.model!r}; load a checkpoint with swm.wm.load, or pass 'simulator'")
            return None
        engine = engine_part(self.model, "_engine_model", "get_cost")
        if engine is not None:
            return engine
        return Adapter(self.model, self.device, self.batch_size, process, transform, history, self._plan_dim)

    def solve(self, info_dict: dict[str, Any], init_action: Any = None) -> dict[str, Any]:
        """Plans for every row of `info_dict` `(B, T, ..)`.

        Each call uses new random numbers. The same sequence of calls with the same seed returns the same plans. (In an
        `MPCPolicy`, they depend on the episode and the number of the plan in it instead.)

        Args:
            info_dict: Infos `(B, T, ..)`.
            init_action: The actions at which the search starts, `(B, at most horizon, action_dim)`, padded with zeros.

        Returns:
            A dict with `actions` `(B, horizon, action_dim)`, `costs` (for each environment, the cost of the cheapest
            candidate of the last iteration), `trace` (the record of each search) and, with callbacks, `callbacks`: the
            history of each callback by its `output_key`, with `_2`, `_3`, … behind it for further callbacks with the same
            key. The other keys depend on the solver.
        """
        config, space = self._configured(), self._space()
        block, horizon, dim = config.action_block, config.horizon, self._plan_dim
        model = self.adapter()
        if model is None:
            raise ValueError(
                "solve: the simulator needs the environments, and solve gets infos only; "
                "use MPCPolicy, with a solver of this package"
            )
        if not isinstance(info_dict, Mapping):
            raise TypeError(f"info_dict: expected a dict of arrays (B, T, ..), got {type(info_dict).__name__}")
        infos = {key: value for key, value in info_dict.items() if not isinstance(value, (list, str))}
        if not infos:
            raise ValueError(f"info_dict: {sorted(info_dict)}; expected at least one array (B, T, ..)")
        envs = len(next(iter(infos.values())))
        if isinstance(model, Adapter):
            model.set_infos(info_dict, envs)
            engine_infos: dict[str, Any] = {}
        else:
            engine_infos = {key: last_step(value) for key, value in infos.items()}
        low, high, choices = _bounds(space, block, model)
        init = None if init_action is None else _padded(init_action, envs, horizon, dim)
        observer = self._observer()
        watched: Any = Watched(model, observer) if isinstance(model, Adapter) else None
        given = model if watched is None else watched
        observer.begin(envs, init)
        plans = PLANS.get()
        PLANS.set(None)
        if plans is not None and len(plans) != envs:
            plans = None  # A user-defined solver plans for other rows.
        with _COUNTING:
            call, self._solved = self._solved, self._solved + 1
        with self._mode(model):
            actions, costs, trace = _engine.solve(
                self.id,
                json.dumps(self.settings),
                given,
                engine_infos,
                envs,
                horizon,
                low,
                high,
                choices,
                init,
                self.seed,
                call,
                plans,
                observer if self.callbacks else None,
                getattr(config, "latency_budget", None),
            )
        observer.end()
        result = {"actions": view(actions), "costs": costs.tolist(), "trace": json.loads(trace)}
        result |= self._outputs(result, watched)
        if self.callbacks:
            result["callbacks"] = _histories(self.callbacks)
        return result

    def _mode(self, model: Any) -> AbstractContextManager[Any]:
        """Torch's inference mode, entered once for all iterations, if the engine computes nothing but costs in Python."""
        if self._descends or self.callbacks or not (isinstance(model, Adapter) and model.torch):
            return nullcontext()
        import torch

        return torch.inference_mode()

    def _outputs(self, result: dict[str, Any], watched: Watched | None) -> dict[str, Any]:
        """The entries of the result that only this solver has, or has otherwise; no `watched` for a checkpoint."""
        return {}

    def _all_settings(self) -> dict[str, Any]:
        """The settings, with the engine's defaults."""
        return {**_defaults()[self.id], **self.settings}

    def _observer(self) -> Observer:
        """What reads the iterations of a search."""
        settings = self._all_settings()
        # Predictive sampling has no elites; its plan is the cheapest candidate.
        elites = 0 if self._descends else int(settings.get("elites", 1))
        sigma, momentum = float(settings.get("sigma", 0.0)), float(settings.get("momentum", 0.0))
        space: Any = self._space()
        limits = (space.low.copy(), space.high.copy()) if isinstance(space, spaces.Box) and self.id == "icem" else None
        fits = self.id not in ("mppi", "predictive_sampling")
        # Only MPPI has a temperature.
        return Observer(self.callbacks, elites, sigma, momentum, limits, fits, settings.get("temperature"))

    def __getattr__(self, name: str) -> Any:
        if isinstance(getattr(type(self), name, None), property):
            self._configured()
        # The settings by their names in the constructor.
        engine = type(self)._names.get(name, name)
        settings = self.__dict__.get("settings", {})
        if engine in settings:
            return settings[engine]
        given = self.__dict__.get("_given", {})
        if name in given:
            return given[name]
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def __call__(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """The same as `solve`."""
        return self.solve(*args, **kwargs)

    def _initial(self, n_envs: int, actions: Any) -> Any:
        """The initial actions `(n_envs, horizon, action_dim)` as a tensor, padded with zeros."""
        import torch

        if actions is None:
            return torch.zeros(n_envs, self.horizon, self._plan_dim, dtype=self.dtype)
        return torch.from_numpy(_padded(actions, n_envs, self.horizon, self._plan_dim)).to(self.dtype)

    def _configured(self) -> Any:
        if self._config is None:
            raise NotConfigured(f"{type(self).__name__}: call configure(action_space=…, n_envs=…, config=…) first")
        return self._config

    def _space(self) -> Any:
        self._configured()
        if self._single is None:
            # Gymnasium's constructors of spaces take as long as ten iterations of a small search.
            self._single = single(self._action_space, self._n_envs)
        return self._single


def _plain(name: str, value: Any) -> Any:
    """A setting as JSON can hold it: numbers of numpy become those of Python.

    Raises:
        ValueError: If a number is NaN or infinite.
    """
    if isinstance(value, Mapping):
        return {key: _plain(f"{name}.{key}", inner) for key, inner in value.items()}
    if isinstance(value, (np.generic, np.ndarray)):
        value = value.tolist()
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{name}={value}; expected a finite number")
    return value


def _histories(callbacks: Sequence[Callback]) -> dict[str, list[list[Any]]]:
    """The history of each callback, by keys that differ."""
    keys = {callback.output_key for callback in callbacks}
    found: dict[str, list[list[Any]]] = {}
    for callback in callbacks:
        key, number = callback.output_key, 1
        while key in found or (number > 1 and key in keys):
            number += 1
            key = f"{callback.output_key}_{number}"
        found[key] = callback.history
    return found


def summed_costs(trace: list[dict[str, Any]], samples: int) -> list[list[float]]:
    """The sum of the costs of all candidates of all environments, in every step of a gradient solver."""
    means = np.array([search["mean"] for search in trace], dtype=np.float64)
    # The last entry is the comparison of the final candidates.
    totals: list[float] = (samples * means.sum(0))[:-1].tolist()
    return [totals]


def last_step(value: Any) -> np.ndarray:
    """The last step `(B, ..)` of an info column `(B, T, ..)`, in a type that the engine supports."""
    if hasattr(value, "detach"):
        value = value.detach().cpu().numpy()
    value = np.asarray(value)
    value = value[:, -1] if value.ndim > 1 else value
    kinds = {"float16": np.float32, "int8": np.int32, "int16": np.int32, "uint16": np.int32, "uint32": np.int64}
    return np.ascontiguousarray(value, dtype=kinds.get(value.dtype.name, value.dtype))


def _dim(space: spaces.Space[Any], block: int) -> int:
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
    if not hasattr(space, "low"):
        raise TypeError(f"action_space: {space}; planners choose actions of Box, Discrete and MultiDiscrete spaces")
    low, high = (np.asarray(side, dtype=np.float32).reshape(-1) for side in (space.low, space.high))
    info, scaler = getattr(model, "info", None), ACTION_SCALER.get()
    if info is not None:
        info = json.loads(info)
        mean, std = (np.asarray(info[name], dtype=np.float32) for name in ("action_mean", "action_std"))
        low, high = (low - mean) / std, (high - mean) / std
    elif scaler is not None:
        low, high = _scaled(scaler, np.stack([low, high]))
    return np.tile(low, block).tolist(), np.tile(high, block).tolist(), None


def _scaled(scaler: Any, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The bounds of actions in the units of plans. A side that has no finite value there is no bound."""
    is_bound = np.isfinite(sides)
    given = np.where(is_bound, sides, 0).astype(np.float32)
    try:
        with np.errstate(all="ignore"):
            scaled = np.asarray(scaler.transform(given), dtype=np.float32)
    except Exception as error:
        raise ValueError(
            f"process['action']: its transform fails for bounds of actions of shape {given.shape}: {error}"
        ) from error
    if scaled.shape != sides.shape:
        raise ValueError(
            f"process['action']: its transform gives the shape {scaled.shape} for bounds of actions of shape {sides.shape}; "
            "expected the same shape: give a scaler of single actions"
        )
    known = is_bound & np.isfinite(scaled)
    lowest = np.where(known.all(0), scaled.min(0), -np.inf)
    highest = np.where(known.all(0), scaled.max(0), np.inf)
    return lowest.astype(np.float32), highest.astype(np.float32)


def _padded(init: Any, envs: int, horizon: int, dim: int) -> np.ndarray:
    """The initial actions, padded with zeros to `(envs, horizon, dim)`."""
    given = _tensors.to_numpy(init)
    if np.ma.is_masked(init) or given.dtype.kind not in "biuf":
        raise ValueError(f"init_action: expected real numbers without masked values, got {given.dtype}")
    init = given.astype(np.float32)
    if init.ndim != 3 or init.shape[0] != envs or init.shape[1] > horizon or init.shape[2] != dim:
        raise ValueError(f"init_action: got shape {init.shape}, expected ({envs}, at most {horizon}, {dim})")
    return np.concatenate([init, np.zeros((envs, horizon - init.shape[1], dim), np.float32)], 1)
