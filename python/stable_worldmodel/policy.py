"""Policies.

A policy is any object whose method `get_action(infos)` returns one action for each environment; `BasePolicy` provides the
other methods. The engine's policies (random, experts, checkpoints, planning) run in the engine. An episode that one of these
policies plays depends only on its seed, not on its slot or on other episodes.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from . import _engine, _options
from ._action_spaces import single
from ._overrides import engine_part, is_overridden
from .buffer import HistoryBuffer
from .data import _tensors
from .data.normalization import ZScoreScaler
from .planning.adapter import has_torch, prepared
from .planning.solver.engine import ACTION_SCALER, PLANS, EngineSolver, NotConfigured

if TYPE_CHECKING:
    from .world import World

__all__ = [
    "AutoActionableModel",
    "AutoCostModel",
    "BasePolicy",
    "ExpertPolicy",
    "FeedForwardPolicy",
    "MPCPolicy",
    "MixturePolicy",
    "PlanConfig",
    "Policy",
    "RandomPolicy",
    "WorldModelPolicy",
]


@dataclass(frozen=True)
class PlanConfig:
    """The length of a plan and the number of steps that are executed before planning again.

    Attributes:
        horizon: Model steps to plan; solvers of the engine accept at most 10,000, as for the other numbers of steps.
        receding_horizon: Model steps to execute before planning again; a value equal to `horizon` is open loop.
        history_len: The number of frames that the model gets, including the current frame.
        action_block: Environment steps in one model step (the frameskip that the model was trained with).
        warm_start: Whether a search starts from the part of the last plan that was not executed.
        latency_budget: Seconds after which a search stops with its best plan; results then depend on the machine.
    """

    horizon: int = 5
    receding_horizon: int = 5
    history_len: int = 1
    action_block: int = 1
    warm_start: bool = True
    latency_budget: float | None = None

    def __post_init__(self) -> None:
        for name in ("horizon", "receding_horizon", "history_len", "action_block"):
            # The class is frozen. Numbers of numpy become those of Python, which JSON can hold.
            object.__setattr__(self, name, _options.count(f"PlanConfig.{name}", getattr(self, name)))
        if not isinstance(self.warm_start, (bool, np.bool_)):
            raise ValueError(f"PlanConfig.warm_start: {self.warm_start!r}; expected True or False")
        object.__setattr__(self, "warm_start", bool(self.warm_start))
        if self.latency_budget is not None:
            object.__setattr__(self, "latency_budget", _seconds("PlanConfig.latency_budget", self.latency_budget))
        if self.receding_horizon > self.horizon:
            raise ValueError(
                f"PlanConfig: receding_horizon={self.receding_horizon} steps to execute exceed the {self.horizon} planned "
                "steps (horizon); lower receding_horizon or raise horizon"
            )

    @property
    def plan_len(self) -> int:
        """Environment steps of a plan."""
        return self.horizon * self.action_block


def _seconds(name: str, value: Any) -> float:
    """The value as a positive time."""
    try:
        seconds = math.nan if isinstance(value, (str, bytes, bool)) else float(value)
    except (TypeError, ValueError, OverflowError):
        seconds = math.nan
    if not (math.isfinite(seconds) and seconds > 0):
        raise ValueError(f"{name}: {value!r}; expected more than 0 seconds, or None for no limit")
    return seconds


def _misspelt(name: str, kind: type[Any]) -> str | None:
    """The parameter of a class of this package that a keyword probably means."""
    if hasattr(kind, name) or not kind.__module__.startswith("stable_worldmodel."):
        return None
    import difflib
    import inspect

    parameters = inspect.signature(kind).parameters.values()
    known = [parameter.name for parameter in parameters if parameter.kind is not inspect.Parameter.VAR_KEYWORD]
    return next(iter(difflib.get_close_matches(name, known, 1, 0.75)), None)


class BasePolicy:
    """Base class of policies.

    Args:
        **kwargs: Attributes of the policy.

    Raises:
        TypeError: If a keyword is a misspelt parameter of a class of this package.
    """

    #: The kind of the policy, for manifests and results; the name of the class for `"base"`, and for the name of a policy of
    #: the engine, such as `"random"`.
    type = "base"

    def __init__(self, **kwargs: Any) -> None:
        self.env: Any = None
        for name, value in kwargs.items():
            if meant := _misspelt(name, type(self)):
                raise TypeError(f"{type(self).__name__}: unknown argument {name!r}; did you mean {meant!r}?")
            setattr(self, name, value)

    def __getstate__(self) -> dict[str, Any]:
        """The attributes without the environments, which a copy gets from `set_env` or `World.set_policy`."""
        return {**self.__dict__, "env": None}

    def set_env(self, env: Any) -> None:
        """Sets the environments that the policy acts in: `world.envs`."""
        self.env = env

    def get_action(self, obs: Any, **kwargs: Any) -> Any:
        """The actions `(num_envs, ..)` for infos `(num_envs, T, ..)`."""
        raise NotImplementedError(f"{type(self).__name__} has no get_action(infos)")

    def _actor(self, world: World) -> Any:
        """The engine's actor that implements this policy; `None` if the policy runs in Python."""
        return None


Policy = BasePolicy


class _EnginePolicy(BasePolicy):
    """A policy that acts inside the engine."""

    #: What changes with its settings, such as how often they changed: a `World` makes a new actor then.
    _changes: Any = 0

    def get_action(self, obs: Any, **kwargs: Any) -> np.ndarray:
        """The actions for the current infos of the world; `obs` is ignored."""
        if getattr(self.env, "_world", None) is None:
            name = type(self).__name__
            raise NotConfigured(f"{name}: it acts in the environments of a World; call world.set_policy(policy) first")
        actions: np.ndarray = self.env._world._engine_actions(self)
        return actions


class RandomPolicy(_EnginePolicy):
    """Samples actions uniformly from the action space: of a World, or of any object with an `action_space`.

    Args:
        seed: Combined with the seed of each episode in a World; elsewhere the seed of the action space.
    """

    type = "random"

    def __init__(self, seed: int | None = None, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.seed = seed

    def set_env(self, env: Any) -> None:
        super().set_env(env)
        if env is not None and not self._is_in_world() and self.seed is not None:
            env.action_space.seed(self.seed)

    def set_seed(self, seed: int) -> None:
        """Sets the policy's seed, in every world that it acts in."""
        self._changes += seed != self.seed
        self.seed = seed
        if self._is_in_world():
            self.env._world._drop_actor(self)
        elif self.env is not None:
            self.env.action_space.seed(seed)

    def get_action(self, obs: Any, **kwargs: Any) -> np.ndarray:
        """The actions `(num_envs, ..)`; `obs` is ignored."""
        if self.env is None or self._is_in_world():
            return super().get_action(obs)
        sampled: np.ndarray = self.env.action_space.sample()
        return sampled

    def _is_in_world(self) -> bool:
        from .world.env_pool import WorldEnvs

        return isinstance(self.env, WorldEnvs)

    def _actor(self, world: World) -> Any:
        return _engine.Actor.random(world._world, self.seed)


class ExpertPolicy(_EnginePolicy):
    """An expert of the environment: a scripted one, or the capsule of the zoo that is named `expert`.

    Args:
        name: One of `swm.envs.experts(ID)`; `"expert"` selects the first one.
        seed: Combined with the seed of each episode.
    """

    type = "expert"

    def __init__(self, name: str = "expert", seed: int | None = None, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.name, self.seed = name, seed
        self.type = name

    def get_action(self, obs: Any, goal_obs: Any = None, **kwargs: Any) -> np.ndarray:
        """The actions for the current infos of the world; the arguments are ignored."""
        return super().get_action(obs)

    def _actor(self, world: World) -> Any:
        return _engine.Actor.expert(world._world, self.name, self.seed)


class MixturePolicy(_EnginePolicy):
    """Plays every episode with one of several policies; the episode's seed and index decide which.

    Args:
        weights: The weight of each policy by name: `"random"`, `"expert"`, another expert, or a checkpoint that acts without
            a solver. A policy plays a share of the episodes that is its weight divided by the sum of all weights.

    The column `policy_index` of a dataset that several policies collected holds the index of the episode's policy in `weights`.
    """

    type = "mixture"

    def __init__(self, weights: Mapping[str, float], **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.weights = {str(name): _options.finite(f"the weight of {name!r}", weight) for name, weight in weights.items()}

    @property
    def _changes(self) -> Any:
        return tuple(self.weights.items())

    @property
    def _choice(self) -> list[dict[str, Any]]:
        """The policies and weights, as a manifest stores them."""
        return [{"name": name, "weight": weight} for name, weight in self.weights.items()]

    def _actor(self, world: World) -> Any:
        actor = _engine.Actor.mixture(world._world, json.dumps(self._choice))
        own = _engine.Actor.experts(world.env_name) if world.env_name.partition(",")[0] in _engine.envs() else []
        models = [name for name in self.weights if name not in ("random", "expert", *own)]
        if world._infos_differ and models:
            raise ValueError(
                f"MixturePolicy: {models[0]} acts in the engine, where the world's image_transform, goal_transform and "
                "goal_conditioned=False have no effect; leave them out, or play it as a FeedForwardPolicy"
            )
        return actor


class FeedForwardPolicy(BasePolicy):
    """Acts with one forward pass of a model: an `Actionable`, or a checkpoint with a policy.

    Args:
        model: An object with `get_action(info)`, or a checkpoint's name or path.
        process: Scalers by column; the scaler of `action` converts actions back (`inverse_transform`). `None` for those of
            the model (`model.process`), which torch modules of checkpoints have.
        transform: Transforms of frames by column, called with one frame `(C, H, W)` at a time.

    Raises:
        ValueError: If a checkpoint of the engine, which scales its inputs itself, is given with `process` or `transform`.
    """

    type = "feed_forward"

    def __init__(
        self,
        model: Any,
        process: Mapping[str, Any] | None = None,
        transform: Mapping[str, Callable[[Any], Any]] | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        model = os.fspath(model) if isinstance(model, os.PathLike) else model
        self.model, self.process, self.transform = model, _process(process, model), dict(transform or {})
        if self._checkpoint() is not None and (self.process or self.transform):
            raise ValueError(
                "FeedForwardPolicy: checkpoints of the engine scale their inputs themselves; remove process and transform"
            )
        if hasattr(model, "eval") and not isinstance(model, str):
            model.eval()

    def _checkpoint(self) -> Any:
        """The name or path of the checkpoint that acts, or the engine's model; `None` for a model in Python."""
        return self.model if isinstance(self.model, str) else engine_part(self.model, "_engine_policy", "get_action")

    def _actor(self, world: World) -> Any:
        model = self._checkpoint()
        if model is None or world._infos_differ:
            # Transforms of frames are functions in Python, so the checkpoint is called from here.
            return None
        return (_engine.Actor.checkpoint if isinstance(model, str) else _engine.Actor.model)(world._world, model)

    def get_action(self, info_dict: Any, **kwargs: Any) -> Any:  # type: ignore[override]
        """The actions `(num_envs, ..)` for infos `(num_envs, T, ..)`."""
        model = self.model
        if self._checkpoint() is not None:
            if self.env is None:
                raise RuntimeError("FeedForwardPolicy: it belongs to no world; call world.set_policy(policy) first")
            world = self.env._world
            if not world._infos_differ:
                return world._engine_actions(self)
            if isinstance(model, str):
                from . import wm

                # Only infos that differ from those of the engine need the checkpoint in Python.
                model = self.model = wm.load(model)
        infos = prepared({key: value for key, value in info_dict.items() if key[0] != "_"}, self.process, self.transform)
        if "goal" in infos:
            infos["goal_pixels"] = infos["goal"]
        if has_torch():
            import torch

            try:
                device = next(model.parameters()).device
            except (AttributeError, StopIteration, TypeError):
                device = torch.device("cpu")
            infos = {key: value.to(device) if torch.is_tensor(value) else value for key, value in infos.items()}
            with torch.inference_mode():
                action = model.get_action(infos)
            action = action.cpu().numpy() if torch.is_tensor(action) else np.asarray(action)
        else:
            action = np.asarray(model.get_action(infos))
        return self.process["action"].inverse_transform(action) if "action" in self.process else action


class MPCPolicy(BasePolicy):
    """Model predictive control: plans with a solver, executes the first steps of the plan, and plans again.

    Args:
        solver: A solver of `swm.solver`, or an object with `configure` and `solve`.
        config: The planning config; by default 5 model steps, all of them executed, with the model's `action_block` (1 if the
            model has none) and one frame of history (`model.card["history"]` is what a model was trained with).
        process: Scalers by column, applied before the model (`transform`); the scaler of `action` converts planned actions
            back (`inverse_transform`). `None` for those of the model (`model.process`), which torch modules of checkpoints
            have.
        transform: Transforms by frame column (`pixels`, `goal`), called with one frame `(C, H, W)` at a time.
        history_keys: The columns of which a user-defined solver gets the last `history_len` model steps. The engine's solvers
            get past `pixels`.

    The model gets the infos `(B, T, ..)` of the environments that replan.
    """

    type = "world_model"
    #: Planned in Python, it has the plans of the environments of one world, that of the last `set_policy`.
    _of_one_world = True

    def __init__(
        self,
        solver: Any,
        config: PlanConfig | None = None,
        process: Mapping[str, Any] | None = None,
        transform: Mapping[str, Callable[[Any], Any]] | None = None,
        history_keys: Sequence[str] = ("pixels",),
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        if not all(callable(getattr(solver, name, None)) for name in ("configure", "solve")):
            raise TypeError(f"{type(solver).__name__} is not a solver: expected configure(…) and solve(…)")
        self.solver = solver
        model = getattr(solver, "model", None)
        block = int(getattr(model, "action_block", 1))
        if config is None:
            config = PlanConfig(action_block=block)
        elif isinstance(getattr(model, "_engine_model", None), _engine.Model) and config.action_block != block:
            raise ValueError(f"PlanConfig.action_block: {config.action_block}; {model} was trained with {block}")
        self.cfg = self.config = config
        self.process, self.transform = _process(process, model), dict(transform or {})
        #: The search traces of the last `evaluate`, one dict for each plan, if the engine plans.
        self.plans: list[dict[str, Any]] = []
        self.history_keys = tuple(history_keys)
        self._actions: list[list[np.ndarray]] = []
        self._rest: dict[int, Any] = {}
        #: The past columns and the executed actions, in model units, of every environment.
        self._seen: list[HistoryBuffer] = []
        #: The number of plans in the episode of every environment, and of resets of the environments of an `EnvPool`.
        self._planned: list[int] = []
        self._resets = np.zeros(0, np.int64)
        #: The last scaler of actions, with its mean and deviation.
        self._known_scale: tuple[Any, tuple[list[float], list[float]] | None] | None = None
        self._done: list[HistoryBuffer] = []

    @property
    def flatten_receding_horizon(self) -> int:
        """Environment steps that are executed before planning again."""
        return self.cfg.receding_horizon * self.cfg.action_block

    def set_env(self, env: Any) -> None:
        super().set_env(env)
        self.solver.configure(action_space=env.action_space, n_envs=env.num_envs, config=self.cfg)
        self._actions = [[] for _ in range(env.num_envs)]
        self._rest = {}
        self._planned = [0] * env.num_envs
        self._resets = np.zeros(env.num_envs, np.int64)
        # The scaler may have been fitted again.
        self._known_scale = None
        steps = max(1, (self.cfg.history_len - 1) * self.cfg.action_block)
        block = self.cfg.action_block
        self._seen = [HistoryBuffer(1, steps + 1, block) for _ in range(env.num_envs)]
        self._done = [HistoryBuffer(1, steps, block, ("action",)) for _ in range(env.num_envs)]

    @property
    def _scaler(self) -> Any:
        """The scaler of actions: the given one, or that of the checkpoint; `None` if plans are in the environment's units."""
        if "action" in self.process or not isinstance(self.solver, EngineSolver):
            return self.process.get("action")
        card = getattr(self.solver.model, "card", None)
        if not (isinstance(card, Mapping) and "action_mean" in card):
            return None
        mean, std = (np.asarray(card[name], dtype=np.float32) for name in ("action_mean", "action_std"))
        return ZScoreScaler(mean, std)

    def _actor(self, world: World) -> Any:
        if not isinstance(self.solver, EngineSolver) or is_overridden(self.solver, "solve"):
            return None
        # Another world may have taken the solver meanwhile.
        self.solver.configure(action_space=world.envs.action_space, n_envs=world.num_envs, config=self.cfg)
        simulates = isinstance(self.solver.model, str) and self.solver.model == "simulator"
        if simulates and world._wrapped_in_python:
            raise ValueError(
                "the simulator plays environments without wrappers written in Python; plan in a World that has none"
            )
        engine = engine_part(self.solver.model, "_engine_model", "get_cost")
        if engine is not None and (self.process or self.transform):
            raise ValueError("MPCPolicy: models of swm.wm scale their inputs themselves; remove process and transform")
        if world._infos_differ and not simulates:
            if engine is not None and self.cfg.history_len > 1:
                raise ValueError(
                    "MPCPolicy: models of swm.wm get no history in a world with image_transform, goal_transform or "
                    "goal_conditioned=False; use history_len=1"
                )
            # Transforms of frames are functions in Python, so the solver is called from here.
            return None
        scaler = None if engine is not None else self._scaler
        scale = None if scaler is None else self._scale_of(scaler, single(world.envs.action_space, world.num_envs))
        if scale is None and scaler is not None:
            return None
        model = self.solver.adapter(self.process, self.transform, self.cfg.history_len)
        # A class derived from PlanConfig can have fields of its own.
        cfg = {field.name: getattr(self.cfg, field.name) for field in fields(PlanConfig)}
        cfg["history"] = cfg.pop("history_len")
        settings = json.dumps(self.solver.settings)
        seed, observer = self.solver.seed, self.solver._observer() if self.solver.callbacks else None
        plan = json.dumps(cfg)
        return _engine.Actor.planning(world._world, self.solver.id, settings, plan, scale, model, seed, observer)

    def _scale_of(self, scaler: Any, space: Any) -> tuple[list[float], list[float]] | None:
        """See `_scale`; a scaler is asked once, because `World.step` may ask in every step."""
        if self._known_scale is None or self._known_scale[0] is not scaler:
            self._known_scale = (scaler, _scale(scaler, space))
        return self._known_scale[1]

    # Planning in Python, for user-defined solvers.

    def get_action(self, info_dict: Any, **kwargs: Any) -> np.ndarray:  # type: ignore[override]
        """The actions `(num_envs, ..)` for infos `(num_envs, T, ..)`."""
        if self.env is None:
            raise RuntimeError("MPCPolicy: it belongs to no world; call world.set_policy(policy) first")
        infos = dict(info_dict)
        fresh, active, episodes = (infos.pop(name, None) for name in ("_needs_flush", "_active", "_episode"))
        envs = self.env.num_envs
        resets = getattr(self.env, "_resets", None)
        if fresh is None and resets is not None:
            fresh, self._resets = resets != self._resets, resets.copy()
        for i in range(envs):
            if fresh is not None and fresh[i]:
                self._actions[i].clear()
                self._rest.pop(i, None)
                self._planned[i] = 0
                self._seen[i].reset()
                self._done[i].reset()
        over = np.zeros(envs, bool) if active is None else ~np.asarray(active, bool)
        due = [i for i in range(envs) if not self._actions[i] and not over[i]]
        if self.cfg.history_len > 1:
            past = {key: np.asarray(infos[key]) for key in self.history_keys if key in infos}
            for i in np.flatnonzero(~over).tolist():
                self._seen[i].append({key: value[i : i + 1] for key, value in past.items()})
        if due:
            known = None if episodes is None else [int(episodes[i]) for i in due]
            self._replan({key: np.asarray(value)[due] for key, value in infos.items()}, due, known)
        space = single(self.env.action_space, self.env.num_envs)
        shape = space.shape
        actions = np.full((envs, *shape), np.nan if space.dtype.kind == "f" else 0, dtype=space.dtype)
        for i in range(envs):
            if not over[i]:
                actions[i] = self._actions[i].pop(0).reshape(shape)
        if self.cfg.history_len > 1:
            units, scaler = actions.reshape(envs, -1), self._scaler
            units = units if scaler is None else np.asarray(scaler.transform(units))
            for i in np.flatnonzero(~over).tolist():
                self._done[i].append({"action": units[i : i + 1].astype(np.float32)})
        return actions

    def _with_history(self, infos: dict[str, Any], due: list[int]) -> dict[str, Any]:
        """The infos with the past model steps: columns `(B, history_len, ..)` and `action_history`.

        Before the first step, the history repeats the first observation, and the actions are zero.
        """
        length = self.cfg.history_len
        if length == 1:
            return infos
        columns = [self._seen[i].get(length) or {} for i in due]
        for key in columns[0]:
            past = [column[key][0] for column in columns]
            infos[key] = np.stack([np.concatenate([steps[:1]] * (length - len(steps)) + [steps]) for steps in past])
        space = single(self.env.action_space, self.env.num_envs)
        size = int(np.prod(space.shape or (1,))) * self.cfg.action_block
        actions = np.zeros((len(due), length - 1, size), np.float32)
        for row, i in enumerate(due):
            done = self._done[i].get(length - 1)
            if done is not None:
                blocks = done["action"][0].reshape(-1, size)
                actions[row, length - 1 - len(blocks) :] = blocks
        infos["action_history"] = actions
        return infos

    def _replan(self, infos: dict[str, Any], due: list[int], episodes: list[int] | None) -> None:
        """Plans for the environments `due`, in episodes with these keys."""
        known = [self._rest.get(i) for i in due]
        init: Any = None
        if self.cfg.warm_start and any(rest is not None for rest in known):
            template = next(rest for rest in known if rest is not None)
            # Solvers for discrete actions take -1 as no known option.
            unknown = np.full_like(template, -1 if isinstance(self.solver, EngineSolver) and template.dtype.kind == "i" else 0)
            init = np.stack([unknown if rest is None else rest for rest in known])
            if has_torch():
                import torch

                init = torch.from_numpy(init)
        # The history of actions is in model units already.
        known_units = {key: value for key, value in self._with_history(infos, due).items() if key != "action_history"}
        given = prepared(known_units, self.process, self.transform)
        if "action_history" in infos:
            given |= prepared({"action_history": infos["action_history"]}, {}, {})
        # So that a plan depends neither on the other environments nor on earlier episodes.
        plans = [(episode, self._planned[i]) for episode, i in zip(episodes or [], due, strict=False)]
        scaler = self._scaler
        tokens = PLANS.set(plans or None), ACTION_SCALER.set(scaler)
        try:
            outcome = self.solver.solve(given, init_action=init)
        finally:
            PLANS.reset(tokens[0])
            ACTION_SCALER.reset(tokens[1])
        for i in due:
            self._planned[i] += 1
        if not isinstance(outcome, Mapping) or "actions" not in outcome:
            raise TypeError(f"{type(self.solver).__name__}.solve: expected a dict with 'actions', got {outcome!r:.200}")
        plan = outcome["actions"]
        if np.ma.is_masked(plan):
            raise ValueError(f"{type(self.solver).__name__}.solve: expected actions without masked values, got {plan}")
        plan = _tensors.to_numpy(plan)
        if plan.ndim != 3 or plan.shape[0] != len(due) or plan.shape[1] < self.cfg.receding_horizon:
            raise ValueError(
                f"{type(self.solver).__name__}.solve: got actions of shape {plan.shape}, expected "
                f"({len(due)}, {self.cfg.horizon}, dimension of a model step)"
            )
        if plan.dtype.kind == "c":
            raise ValueError(
                f"{type(self.solver).__name__}.solve: expected real actions, got complex numbers; give their real part"
            )
        if not np.isfinite(plan).all():
            raise ValueError(f"{type(self.solver).__name__}.solve: expected finite actions, got a plan with NaN or infinity")
        space = single(self.env.action_space, self.env.num_envs)
        for row, i in enumerate(due):
            # The solver may write its next plan over this one.
            self._rest[i] = plan[row, self.cfg.receding_horizon :].copy()
            if not len(self._rest[i]):
                del self._rest[i]
            steps = plan[row, : self.cfg.receding_horizon].reshape(self.cfg.receding_horizon * self.cfg.action_block, -1)
            if scaler is not None:
                steps = np.asarray(scaler.inverse_transform(steps))
            self._actions[i] = [_executed(step, space) for step in steps]


WorldModelPolicy = MPCPolicy


def _process(given: Mapping[str, Any] | None, model: Any) -> dict[str, Any]:
    """The given scalers, or those of the model."""
    own = getattr(model, "process", None)
    return dict(given if given is not None else own if isinstance(own, Mapping) else {})


def _executed(step: np.ndarray, space: Any) -> np.ndarray:
    """A planned step as an action: clipped to a `Box`, or the choices of one-hot vectors."""
    if isinstance(space, spaces.Box):
        # A `Box` of whole numbers with few options is a `MultiDiscrete` here.
        step = step if space.dtype.kind == "f" else step.round()
        clipped: np.ndarray = np.clip(step.reshape(space.shape), space.low, space.high).astype(space.dtype)
        return clipped
    sizes = [int(n) for n in np.reshape(getattr(space, "nvec", getattr(space, "n", 0)), -1)]
    if step.size == len(sizes):
        return step.round().astype(space.dtype)
    choices, at = [], 0
    for size in sizes:
        choices.append(int(step[at : at + size].argmax()))
        at += size
    start = np.reshape(getattr(space, "start", 0), -1)
    action: np.ndarray = np.asarray(choices, dtype=space.dtype) + start
    return action


def _scale(scaler: Any, space: Any) -> tuple[list[float], list[float]] | None:
    """The mean and standard deviation of a scaler; `None` if the scaler has neither, or does not convert actions with them."""
    size = int(np.prod(space.shape or (1,)))
    for names in (("mean", "std"), ("mean_", "scale_")):
        if all(getattr(scaler, name, None) is not None for name in names):
            given = [getattr(scaler, name) for name in names]
            try:
                mean, std = (np.broadcast_to(_array(value).reshape(-1), size) for value in given)
            except (TypeError, ValueError):
                return None
            is_linear = np.all(std > 0) and _converts_with(scaler, mean, std, given[0])
            return (mean.tolist(), std.tolist()) if is_linear else None
    return None


def _converts_with(scaler: Any, mean: np.ndarray, std: np.ndarray, like: Any) -> bool:
    """Whether a scaler converts actions with this mean and deviation. One that fails on a few actions is taken at its word."""
    given = np.outer(_PROBES, np.ones_like(mean))
    try:
        probes: Any = given
        if hasattr(like, "detach"):
            import torch

            probes = torch.as_tensor(given, dtype=like.dtype, device=like.device)
        there, back = _array(scaler.transform(probes)), _array(scaler.inverse_transform(probes))
    except Exception:
        return True
    expected = ((there, (given - mean) / std), (back, given * std + mean))
    return all(found.shape == wanted.shape and np.allclose(found, wanted, 1e-4, 1e-5) for found, wanted in expected)


def _array(value: Any) -> np.ndarray:
    return np.asarray(value.detach().cpu().numpy() if hasattr(value, "detach") else value, dtype=np.float32)


#: Values at which a scaler shows whether it is what its mean and deviation say.
_PROBES = np.array([-7.3, -2.1, -1.0, -0.4, 0.0, 0.3, 0.9, 1.7, 5.2], np.float32)


def AutoCostModel(run_name: str, cache_dir: Any = None) -> Any:
    """Loads a checkpoint to plan with, by name or path: as `swm.wm.load`, or a torch module that `save_pretrained` saved.

    A path that holds a checkpoint counts before a name under `$STABLEWM_HOME/checkpoints`, and a name under `cache_dir` before
    a path, as in `swm.wm.load_pretrained`.
    """
    from pathlib import Path

    from . import wm
    from .wm._located import is_module, located

    path = located(str(run_name), cache_dir)
    if path is not None and is_module(path):
        return wm.utils.load_pretrained(path.resolve()).eval()
    # What is not found is a capsule of the zoo, or a URI, or an error.
    return wm.load(str(path or (run_name if cache_dir is None else Path(cache_dir) / run_name)))


def AutoActionableModel(run_name: str, cache_dir: Any = None) -> Any:
    """Loads a checkpoint with a policy, by name or path, as `swm.wm.load`."""
    return AutoCostModel(run_name, cache_dir)
