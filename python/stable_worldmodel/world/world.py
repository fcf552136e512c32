"""`World`: a batch of environments that a policy acts in, for interactive loops, collection and evaluation."""

from __future__ import annotations

import ast
import hashlib
import json
import os
import re
import secrets
import sys
import warnings
import weakref
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from .. import _engine, _files, _gym, _options, _progress
from .. import spaces as swm_spaces
from .._lazy import lazy
from .._overrides import is_overridden
from ..data import _tensors
from ..wrapper.visual import engine_wrappers
from .env_pool import WorldEnvs, chosen
from .experts import check_experts
from .metrics import Metrics
from .records import (
    collected_policy,
    evaluation_manifest,
    policy_name,
    stored_policy,
    wrapper_records,
    wrapper_words,
)
from .transforms import FrameTransforms

__all__ = ["World"]

#: The dataset format of each path suffix.
_FORMAT_OF_SUFFIX = {".lance": "lance", ".h5": "hdf5", ".hdf5": "hdf5", ".mp4": "video", ".lerobot": "lerobot"}


class World:
    """A batch of environments of one kind, stepped and rendered in parallel.

    Args:
        env_name: An environment's id, such as `swm/PushT-v1`, with options as `ID,option=value`; or any id that is
            registered with Gymnasium.
        num_envs: The number of environments. Episodes do not depend on this number, unless a wrapper keeps statistics from one
            episode to the next, as `NormalizeObservation` of Gymnasium does: a warning names it.
        image_shape: `(height, width)` of frames.
        max_episode_steps: Steps after which episodes are truncated; the environment's time limit for `None`.
        goal_conditioned: Whether the infos contain `goal`, the frame of the goal. Without it, models that read it fail.
        extra_wrappers: Wrappers of every environment, in order: `functools.partial` of a class of `swm.wrapper.visual`, or
            any factory of a `gymnasium.Wrapper`.
        pre_wrappers: Wrappers applied before `extra_wrappers`.
        image_transform: A function of a frame, a `PIL.Image` if Pillow is installed, else an array `(height, width, 3)`. Its
            results replace `pixels` in the infos that policies get; datasets and videos have the frames themselves.
        goal_transform: The same for `goal`.
        add_pixels: Whether frames are rendered.
        views: Additional camera views: cameras, `depth`, `segmentation`, or `CAMERA:MODALITY`.
        wrap_goal: Whether visual wrappers also change the frame of the goal; only if no wrapper is written in Python.
        threads: The number of worker threads, which does not affect results; 0 uses one for each core.
        workers: Whether each third-party environment runs in a worker process instead of this interpreter. The processes
            step in parallel and are restarted after a crash. They must be able to import the environment.
        image_resample: The interpolation that resizes third-party frames: `"bilinear"`, or `"nearest"` for pixel art. `None`
            takes that of the environment, as worker processes always do.
        **kwargs: Options of the environment.

    Attributes:
        infos: The info columns by name: arrays `(num_envs, 1, ..)` in the engine's memory, which every reset and step
            overwrites. `infos[name].copy()` keeps the values of a step. Factors that the `variation` of a `reset` names are in
            the infos as `variation.KEY`.
    """

    #: The number of environments.
    num_envs: int
    _world: _engine.World

    def __init__(
        self,
        env_name: str,
        num_envs: int = 1,
        image_shape: tuple[int, int] | None = (224, 224),
        max_episode_steps: int | None = None,
        goal_conditioned: bool = True,
        pre_wrappers: Sequence[Callable[..., Any]] | None = None,
        extra_wrappers: Sequence[Callable[..., Any]] | None = None,
        image_transform: Any = None,
        goal_transform: Any = None,
        image_resample: Any = None,
        add_pixels: bool = True,
        *,
        views: Sequence[str] = (),
        wrap_goal: bool = False,
        threads: int = 0,
        workers: bool = False,
        **kwargs: Any,
    ) -> None:
        if add_pixels and image_shape is None:
            raise ValueError("image_shape: None; give (height, width), or add_pixels=False for no frames")
        if add_pixels and not (
            isinstance(image_shape, Sequence) and not isinstance(image_shape, str) and len(image_shape) == 2
        ):
            raise TypeError(f"image_shape: {image_shape!r}; expected (height, width)")
        num_envs = _options.count("num_envs", num_envs)
        if max_episode_steps is not None:
            max_episode_steps = _options.count("max_episode_steps", max_episode_steps)
        threads = _options.count("threads", threads, 0)
        if isinstance(views, str):
            raise TypeError(f"views: {views!r}; expected a list, such as [{views!r}]")
        nearest = _gym.is_nearest(image_resample)
        if nearest is not None and workers and not self._is_native(env_name):
            raise ValueError(
                f"image_resample: {image_resample!r}; worker processes resize as the environment's attribute swm_pixel_art "
                "says; set it, or use workers=False"
            )
        kwargs.pop("render_mode", None)
        if not self._is_native(env_name):
            kwargs = {key: _literal(value) for key, value in kwargs.items()}
        self.env_name = ",".join([env_name, *(f"{key}={value}" for key, value in kwargs.items())])
        self.num_envs = num_envs
        image = None
        if add_pixels and image_shape is not None:
            image = (_options.count("image_shape", image_shape[0]), _options.count("image_shape", image_shape[1]))
        wrappers = [*(pre_wrappers or []), *(extra_wrappers or [])]
        in_engine = engine_wrappers(wrappers)
        #: Whether wrappers written in Python change the environments.
        self._wrapped_in_python = in_engine is None
        self._native = in_engine is not None and self._is_native(env_name)
        #: For manifests: the factories of all wrappers, whether the engine's ones change the frame of the goal, and the
        #: interpolation of frames if it is not that of the environment.
        self._wrappers, self._wrap_goal = wrappers, bool(wrap_goal)
        self._resampled: str | None = None
        #: The descriptions of wrappers and transforms, from the first collection or evaluation on that has a manifest.
        self._recorded: tuple[list[tuple[str, Any, str | None]], dict[str, tuple[Any, str | None]]] | None = None
        self._image = image
        #: The Gymnasium environments of this world that run in this interpreter.
        self.gym_envs: list[Any] = []
        if wrap_goal and not wrappers:
            warnings.warn("wrap_goal: there are no wrappers, so that it has no effect", stacklevel=2)
        if in_engine is None and workers:
            raise ValueError("workers: user-defined wrappers cannot run in worker processes; use workers=False")
        if not (self._native or (in_engine is not None and workers)):
            if views:
                problem = "only native environments without wrappers written in Python have camera views"
                raise ValueError(f"views: {list(views)!r}; {problem}: leave them out, or leave out the wrappers")
            name, *given = env_name.split(",")
            settings = {**dict(word.split("=", 1) for word in given), **kwargs}
            self._world, self.gym_envs, self._wrapping, self._resampled = _gym.open_world(
                name, settings, self.num_envs, wrappers, image, max_episode_steps, nearest, threads, wrap_goal
            )
        else:
            # Worker processes use this Python interpreter.
            os.environ.setdefault("SWM_PYTHON", sys.executable)
            self._wrapping = in_engine or []
            self._world = _engine.World(
                self.env_name,
                self.num_envs,
                image,
                list(views),
                max_episode_steps,
                threads,
                json.dumps(in_engine),
                wrap_goal,
            )
        self.infos: dict[str, np.ndarray] = self._world.infos()
        has_goal = "goal" in self.infos
        if not goal_conditioned:
            self.infos.pop("goal", None)
        #: The functions that change the frames in infos.
        self.transforms = FrameTransforms(image_transform, goal_transform)
        self._frames = {key: self.infos[key] for key in self.transforms.keys(self.infos)}
        #: Whether models get other infos than those of the engine, so that they are called from Python.
        self._infos_differ = bool(self.transforms) or (has_goal and not goal_conditioned)
        self._actions = self._world.actions()
        self.infos["action"] = self._actions[:, None]
        self.envs = WorldEnvs(self)
        self.policy: Any = None
        #: Whether the engine may step with the policy without calling it.
        self._steps_in_engine = True
        #: The seed of the episodes that `step` plays.
        self.seed: int | None = None
        #: References to policies, their actors, and the `_changes` of the policy then, by the id of the policy. An actor ends
        #: with its policy.
        self._actors: dict[int, tuple[Callable[[], Any], Any, Any]] = {}
        self._episodes = [0] * self.num_envs
        #: The engine's keys of these episodes.
        self._episode_keys = np.zeros(self.num_envs, np.uint64)
        self._next_episode = 0
        #: Whether `collect` or `evaluate` is calling a policy implemented in Python.
        self._calling = False
        #: The seeds of the first episodes, if `reset` got a list.
        self._first_seeds: Sequence[int] = ()
        #: The options of resets, the same for all environments or one for each.
        self._reset_text: str | list[str] = _options.reset(None, {})
        self._fresh = np.ones(self.num_envs, bool)
        #: Whether `_fresh` may be set: a call to numpy takes a tenth of a step call.
        self._any_fresh = True
        #: The factors that resets sample, which the infos contain as `variation.KEY`.
        self._varied: list[str] = []

    @staticmethod
    def _is_native(env_name: str) -> bool:
        name = env_name.split(",")[0]
        if name in _engine.envs():
            return True
        import gymnasium

        # An unregistered id of the namespace `swm` is a misspelt native id. The engine's error suggests similar ids.
        return name.startswith("swm/") and not name.startswith("swm/Craftax") and name not in gymnasium.registry

    # Properties.

    @lazy
    def spec(self) -> dict[str, Any]:
        """The specification of the environments: spaces, info columns, factors."""
        return dict(json.loads(self._world.spec()))

    @property
    def rewards(self) -> np.ndarray:
        """The rewards of the last step, `(num_envs,)`."""
        return self._column("reward")

    @property
    def terminateds(self) -> np.ndarray:
        """Whether the last step terminated the episode, `(num_envs,)`."""
        return self._column("terminated")

    @property
    def truncateds(self) -> np.ndarray:
        """Whether the last step truncated the episode, `(num_envs,)`."""
        return self._column("truncated")

    def _column(self, name: str) -> np.ndarray:
        """The values `(num_envs,)` of an info column."""
        _ = self._world  # An error if the world is closed.
        return self.infos[name][:, 0]

    @property
    def single_action_space(self) -> spaces.Space[Any]:
        """The action space of one environment."""
        return self.envs.single_action_space

    @property
    def action_space(self) -> spaces.Space[Any]:
        """The action space of all environments together."""
        return self.envs.action_space

    @property
    def variation_space(self) -> swm_spaces.Dict:
        """The factors of variation, with their defaults as values: `factors` has those of an environment."""
        return self.envs.variation_space

    @property
    def max_episode_steps(self) -> int:
        """Steps after which episodes are truncated."""
        return self._world.max_episode_steps()

    def factors(self, index: int = 0) -> dict[str, list[float]]:
        """The factors of the current episode of an environment, by key. Colours are whole numbers from 0 to 255."""
        spaces, factors = self.spec["variation"], self._world.factors(self._checked_index(index))
        colours = [key for key in factors if key in spaces and spaces[key]["type"] == "RGBBox"]
        return {**factors, **{key: [int(channel) for channel in factors[key]] for key in colours}}

    def close(self) -> None:
        """Closes the environments and ends their worker processes. The world cannot be used afterwards."""
        self._actors.clear()
        failures: list[Exception] = []
        while self.gym_envs:
            try:
                self.gym_envs.pop(0).close()
            except Exception as error:
                failures.append(error)
        # The arrays keep the engine's world alive: release them first.
        self.infos, self._frames, self._actions = {}, {}, np.empty(0)
        self.__dict__.pop("_world", None)
        if failures:
            raise failures[0]

    def __reduce_ex__(self, protocol: Any) -> Any:
        raise TypeError("a World holds running environments and cannot be pickled; create it in the process that uses it")

    def __getattr__(self, name: str) -> Any:
        if name == "_world":
            raise RuntimeError("World: the world is closed; create a new world")
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def __enter__(self) -> World:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    # Interactive loops.

    def set_policy(self, policy: Any) -> None:
        """Sets the policy: an object with `get_action(infos)`."""
        if isinstance(policy, type):
            raise TypeError(f"{policy.__name__} is a class: pass an instance of it")
        if not (callable(getattr(policy, "get_action", None)) or callable(getattr(policy, "get_actions", None))):
            raise TypeError(f"{type(policy).__name__} is not a policy: expected get_action(infos)")
        if callable(getattr(policy, "set_env", None)):
            policy.set_env(self.envs)
        self.policy = policy
        self._steps_in_engine = not is_overridden(policy, "get_action")
        self._drop_actor(policy)
        if getattr(policy, "seed", None) is not None and callable(getattr(policy, "set_seed", None)):
            policy.set_seed(policy.seed)

    def reset(
        self,
        seed: int | Sequence[int] | None = None,
        options: Mapping[str, Any] | Sequence[Mapping[str, Any] | None] | None = None,
    ) -> None:
        """Starts an episode in every environment and refreshes `infos`.

        Args:
            seed: The seed of the episodes: environment `i` plays episode `i` of this seed, as in `collect` and `evaluate`.
                A list holds the environment seeds of the first episodes; those of later ones follow from it. Random for `None`.
            options: `variation`: factors to sample; `variation_values`: factors to pin; `state`, `goal_state`: start and goal.
                A list holds the options of each environment.

        A reset that fails leaves the seed and the options of the last one.
        """
        factors = self.spec["variation"]
        reset_text: str | list[str]
        if isinstance(options, Sequence):
            if len(options) != self.num_envs:
                raise ValueError(f"options: expected {self.num_envs} dicts, one for each environment, got {len(options)}")
            reset_text = [_options.reset(given, factors) for given in options]
        else:
            reset_text = _options.reset(options, factors)
        named = self._varied_by(options if isinstance(options, Sequence) else [options])
        single = seed is None or isinstance(seed, (int, np.integer))
        first = [] if single else [_seed(given) for given in seed]  # type: ignore[union-attr]
        if not single and len(first) != self.num_envs:
            raise ValueError(f"seed: expected {self.num_envs} seeds, one for each environment, got {len(first)}")
        seed = _seed(seed) if single else _joined(first)  # type: ignore[arg-type]
        slots = range(self.num_envs)
        self._reset_engine([(slot, _seed_of(slot, seed, first)) for slot in slots], reset_text)
        self.seed, self._first_seeds, self._reset_text = seed, first, reset_text
        self._varied = self._varied if named is None else named
        self._episodes, self._next_episode = list(slots), self.num_envs
        self._show_factors(slots)
        self._begin(slots)
        self._transform()

    def _seed_of(self, episode: int) -> int:
        """The environment's seed of an episode since the last `reset`."""
        return _seed_of(episode, self.seed or 0, self._first_seeds)

    def _reset_slots(self, starts: list[tuple[int, int]]) -> None:
        """Resets environments, given as pairs of slot and seed, with the options of the last `reset`."""
        self._reset_engine(starts, self._reset_text)
        self._show_factors([slot for slot, _ in starts])

    def _reset_engine(self, starts: list[tuple[int, int]], options: str | list[str]) -> None:
        """Resets environments, given as pairs of slot and seed, with the same options, or with those of each environment."""
        if isinstance(options, str):
            self._world.reset(starts, options)
        else:
            for slot, seed in starts:
                self._world.reset([(slot, seed)], options[slot])

    def _varied_by(self, options: Sequence[Mapping[str, Any] | None]) -> list[str] | None:
        """The factors that the options sample; `None` if they have no `variation`."""
        given = [one["variation"] for one in options if one and one.get("variation") is not None]
        names = {name for one in given for name in ([one] if isinstance(one, str) else one)}
        keys = [key for key in self.spec["variation"] if names & {"all", key, *_groups(key)}]
        return keys if given else None

    def _show_factors(self, slots: Sequence[int]) -> None:
        """Writes the sampled factors of environments to the infos."""
        for stale in [name for name in self.infos if name.startswith("variation.") and name[10:] not in self._varied]:
            del self.infos[stale]
        for slot in slots if self._varied else ():
            values = self._world.factors(slot)
            for key in self._varied:
                space = self.variation_space.find(key)
                shape = (self.num_envs, 1, *(space.shape or ()))
                column = self.infos.setdefault(f"variation.{key}", np.zeros(shape, space.dtype))
                column[slot, 0] = np.reshape(values[key], shape[2:])

    def _transform(self) -> None:
        """Refreshes the transformed frames in `infos`."""
        for key, frames in self._frames.items():
            self.infos[key] = self.transforms(key, frames)

    def step(self, steps: int = 1) -> None:
        """Steps the environments with the policy and refreshes `infos`. Environments whose episode is over are reset.

        Args:
            steps: The number of steps. With a policy of the engine, all steps run in one call of the engine.
        """
        policy = self.policy
        if policy is None:
            raise RuntimeError("World.step: no policy; call set_policy first")
        steps = 1 if steps == 1 else _options.count("steps", steps, 0)
        if self.seed is None:
            self.reset()
        # A call is a few microseconds long: nothing here is called without need.
        actor = None
        if self._steps_in_engine:
            known = self._actors.get(id(policy))
            is_known = known is not None and known[0]() is policy and known[2] == getattr(policy, "_changes", 0)
            actor = known[1] if known is not None and is_known else self._actor(policy)
        if actor is not None and isinstance(self._reset_text, str):
            begun, self._next_episode = self._world.play(actor, steps, self.seed or 0, self._next_episode, self._reset_text)
            for slot, episode in begun:
                self._episodes[slot] = episode
            if begun:
                slots = [slot for slot, _ in begun]
                self._show_factors(slots)
                self._forget_actions([slot for slot in slots if self.infos["step_idx"][slot] == 0])
            if self._any_fresh:
                self._fresh.fill(False)
                self._any_fresh = False
            if self._frames:
                self._transform()
            return
        for _ in range(steps):
            over = self.terminateds | self.truncateds
            active = ~over
            if active.any():
                infos = {**self.infos, "_needs_flush": self._fresh.copy(), "_active": active}
                infos["_episode"] = self._episode_keys.copy()
                self._actions[:] = self._checked_actions(self.policy, infos, active)
                self._fresh[:] = False
                self._world.advance(active.tolist())
            if over.any():
                slots = np.flatnonzero(over).tolist()
                for slot in slots:
                    self._episodes[slot] = self._next_episode
                    self._next_episode += 1
                self._reset_slots([(slot, self._seed_of(self._episodes[slot])) for slot in slots])
                self._begin(slots)
            self._transform()

    def _step_with(self, actions: Any, mask: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Steps the environments of `mask` whose episode goes on; returns rewards, terminated and truncated."""
        active = ~(self.terminateds | self.truncateds)
        active &= chosen(mask, self.num_envs)
        self._actions[active] = self._engine_form("actions", actions, active)[active]
        self._fresh[active] = False
        self._world.advance(active.tolist())
        self._transform()
        return tuple(
            np.where(active, value, 0).astype(value.dtype) for value in (self.rewards, self.terminateds, self.truncateds)
        )  # type: ignore[return-value]

    def snapshot(self, index: int = 0) -> bytes:
        """The full state of an environment, including its random state."""
        return self._world.snapshot(self._checked_index(index))

    def restore(self, state: bytes, index: int = 0) -> None:
        """Restores a snapshot and refreshes `infos`. The same actions repeat the steps after the snapshot bit for bit; the
        policy, of which a snapshot has nothing, goes on as it was. `step_idx` and the time limit count from the snapshot, and
        `reward` is 0 until the next step, as after a reset.

        In a world without episodes (before the first `reset`, after `collect` or `evaluate`), the other environments start one.
        """
        index = self._checked_index(index)
        if self.seed is None:
            self.reset()
        self._world.restore(index, state)
        self._forget_actions([index])
        self._show_factors([index])
        self._transform()

    def _checked_index(self, index: int) -> int:
        """The index of an environment.

        Raises:
            IndexError: When there is no such environment.
        """
        if not 0 <= index < self.num_envs:
            raise IndexError(f"index: {index!r}; the world has {self.num_envs} environments, with indices from 0")
        return index

    def _forget_actions(self, slots: Sequence[int] | np.ndarray) -> None:
        """Marks in the infos that environments had no action yet: NaN, or -1 for whole numbers."""
        self._actions[slots] = np.nan if self._actions.dtype.kind == "f" else -1

    def _begin(self, slots: Sequence[int]) -> None:
        self._forget_actions(list(slots))
        for slot in slots:
            self._episode_keys[slot] = _engine.World.episode_key(self.seed or 0, self._episodes[slot])
        self._fresh[list(slots)] = True
        self._any_fresh = True
        # Those that act within a policy implemented in Python as well.
        for _, actor, _ in list(self._actors.values()):
            for slot in slots:
                self._world.begin(actor, slot, self.seed or 0, self._episodes[slot])

    def _engine_actions(self, policy: Any) -> np.ndarray:
        """The actions `(num_envs, ..)` of a policy of the engine for the current infos."""
        if self._calling:
            raise RuntimeError(
                f"{type(policy).__name__}: a policy of the engine within one implemented in Python acts in World.step only; "
                "in collect and evaluate, mix policies of the engine with MixturePolicy"
            )
        active = ~(self.terminateds | self.truncateds)
        self._world.act(self._actor(policy), active.tolist())
        shape = self.envs.action_space.shape
        return self._actions.reshape(-1 if shape is None else shape).copy()

    def _checked_actions(self, policy: Any, infos: dict[str, Any], active: np.ndarray) -> np.ndarray:
        """The actions of a policy implemented in Python, checked and in the shape and type of the engine."""
        if getattr(policy, "_of_one_world", False) and policy.env is not self.envs:
            raise RuntimeError(
                f"{type(policy).__name__}: another world took the policy with its set_policy; "
                "call set_policy again, or make a policy for each world"
            )
        get_action = getattr(policy, "get_action", None) or policy.get_actions
        given = get_action(infos)
        _ = self._world  # An error if the policy has closed the world.
        name = type(policy).__name__
        if given is None:
            raise TypeError(f"{name}.get_action returned None; expected actions of shape {self.envs.action_space.shape}")
        return self._engine_form(f"{name}.get_action", given, active)

    def _engine_form(self, what: str, given: Any, active: np.ndarray) -> np.ndarray:
        """Actions `(num_envs, ..)` in the shape and type of the engine.

        Raises:
            ValueError: If they have another shape, or those of active environments are masked, not finite, not real, or too
                large.
        """
        if np.ma.is_masked(given):
            raise ValueError(f"{what}: expected actions without masked values, got {given}")
        given = _tensors.to_numpy(given)
        want = self._actions
        if given.size != want.size or given.shape[:1] != want.shape[:1]:
            expected = self.envs.action_space.shape
            raise ValueError(f"{what}: got actions of shape {given.shape}, expected {expected}")
        given = given.reshape(want.shape)
        others = (str, bytes, complex, np.complexfloating)
        has_others = given.dtype == object and any(isinstance(value, others) for value in given.flat)
        if given.dtype.kind in "cSUmMV" or has_others:
            kinds = {"c": "complex numbers", "O": "complex numbers or texts"}
            kind = kinds.get(given.dtype.kind, str(given.dtype))
            raise ValueError(f"{what}: expected real actions, got {kind}")
        if given.dtype == object:
            # Floats would round large integers.
            is_whole = all(isinstance(value, (int, np.integer)) and -(2**63) <= int(value) < 2**63 for value in given.flat)
            given = given.astype(np.int64 if is_whole else np.float64)
        if given.dtype.kind == "f" and not np.isfinite(given[active]).all():
            raise ValueError(f"{what}: expected finite actions, got {given[active]}")
        if want.dtype.kind != "f":
            if given.dtype.kind == "f" and (given[active] % 1).any():
                raise ValueError(f"{what}: expected whole numbers, got {given[active]}")
            given = np.nan_to_num(given, nan=0)
            with np.errstate(invalid="ignore"):
                whole = given.astype(want.dtype)
            if (whole != given)[active].any():
                raise ValueError(f"{what}: expected integers of {want.dtype}, got {given[active]}")
            given = whole
        return np.ascontiguousarray(given, dtype=want.dtype)

    def _actor(self, policy: Any) -> Any:
        """The engine's actor of a policy; `None` for a policy implemented in Python."""
        known, changes = self._actors.get(id(policy)), getattr(policy, "_changes", 0)
        if known is not None and known[0]() is policy and known[2] == changes:
            return known[1]
        make = getattr(policy, "_actor", None)
        if make is not None and self._wrapped_in_python:
            # A policy of the user that asks an expert may convert its actions.
            check_experts(self, policy, is_asked=is_overridden(policy, "get_action") or policy is not self.policy)
        actor = make(self) if make is not None else None
        if actor is not None:
            self._actors[id(policy)] = (_reference(policy, self._actors), actor, changes)
            for slot in range(self.num_envs):
                self._world.begin(actor, slot, self.seed or 0, self._episodes[slot])
        return actor

    def _drop_actor(self, policy: Any) -> None:
        self._actors.pop(id(policy), None)

    def _playing(self, policy: Any) -> Any:
        """The actor of a policy for collection and evaluation. A policy implemented in Python gets an actor that calls it."""
        actor = None if is_overridden(policy, "get_action") else self._actor(policy)
        if actor is not None:
            return actor

        def call(infos: dict[str, Any], active: np.ndarray, fresh: np.ndarray, episodes: np.ndarray) -> np.ndarray:
            self._forget_actions(fresh)
            infos |= {"_needs_flush": fresh, "_active": active, "_episode": episodes, "action": self.infos["action"]}
            if "goal" not in self.infos:
                infos.pop("goal", None)
            for key in self._frames.keys() & infos.keys():
                infos[key] = self.transforms(key, infos[key])
            self._calling = True
            try:
                return self._checked_actions(policy, infos, active)
            finally:
                self._calling = False

        return _engine.Actor.python(self._world, call)

    # Collection and evaluation.

    def collect(
        self,
        path: str | os.PathLike[str] | None = None,
        episodes: int = 0,
        seed: int | None = None,
        options: Mapping[str, Any] | None = None,
        format: str | None = None,
        writer: Any = None,
        progress: bool = True,
        *,
        dataset_path: str | os.PathLike[str] | None = None,
        policy: Any = None,
        mode: str = "error",
        codec: str | None = None,
        goal: bool = False,
        strict_finite: bool = False,
        action_noise: float = 0.0,
    ) -> dict[str, int]:
        """Collects episodes with the policy into a dataset.

        Args:
            path: The target: a path, a URI of an object store, or a name under `$STABLEWM_HOME/datasets`.
            episodes: The number of episodes.
            seed: The seed, which is combined with the index of each episode; random for `None`.
            options: Factors to sample (`variation`) and to pin (`variation_values`). `variation` replaces the factors that a
                reset samples by itself, such as the start: name these as well, or all episodes start alike.
            format: One of `swm.data.list_formats()`. `None` selects the format by the path's suffix, or Lance.
            writer: Instead of a path: an object with `write_episode(dict of arrays)`, such as `swm.data.ReplayBuffer`.
            progress: Whether to show progress.
            dataset_path: Another name for `path`.
            policy: The policy to set first; `None` keeps the policy of `set_policy`. A dict of weights by policy name, such as
                `{"expert": 0.7, "random": 0.3}`, stands for `swm.policy.MixturePolicy`. The manifest has the policy's name,
                the `seed` of a policy of the engine (`random,seed=3`), the settings of a planner, and the hash of the weights
                of torch modules. A policy of your own is recorded by its `type` or the name of its class, and such a hash.
            mode: The treatment of an existing dataset: `"error"` raises, `"overwrite"` replaces it, `"append"` adds `episodes`
                more, `"resume"` continues until the dataset has `episodes`. Both continue only with the recorded settings,
                policy and wrappers. A policy of your own that learns begins its dataset with `"append"`, too, which records
                no weights of it.
            codec: The codec of frames: `"qoi"` (lossless), `"png"`, `"jpeg"` or `"jpeg-QUALITY"`.
            goal: Whether to store the frame of the goal in every row.
            strict_finite: Whether NaN and infinite values raise an error. Otherwise they are stored and counted in the
                manifest, and a warning lists the columns.
            action_noise: The standard deviation of Gaussian noise, in the units of the action space, that is added to every
                action; that of the policy (`action_noise` of experts in `swm.envs`) for 0. Actions are clipped to the
                space and stored as executed.

        Returns:
            A dict with the counts `episodes` (in the dataset), `added` (episodes) and `steps`. After an interrupt or an error
            the finished episodes remain stored.
        """
        path = dataset_path if path is None else path
        # Formats of the user get the path as it is given.
        given, path = path, None if path is None else os.fspath(path)
        if (path is None) == (writer is None):
            raise ValueError("World.collect: expected either a path or a writer")
        if mode not in ("error", "overwrite", "append", "resume"):
            raise ValueError(f"mode: {mode!r}; expected 'error', 'overwrite', 'append' or 'resume'")
        if goal and self._image is None:
            raise ValueError("goal: the world has no frames (add_pixels=False), so it has none of the goal; leave goal out")
        episodes = _options.count("episodes", episodes)
        action_noise = _options.finite("action_noise", action_noise)
        if isinstance(policy, Mapping):
            from ..policy import MixturePolicy

            policy = MixturePolicy(policy)
        self._world.check_storable()
        policy = self._chosen(policy)
        if writer is None and format is None:
            format = _FORMAT_OF_SUFFIX.get(Path(path or "").suffix)
        first, kind = 0, None
        if path is not None and given is not None and writer is None and format not in _engine.formats():
            from ..data.format import foreign_episodes, user_defined

            kind = user_defined(given, format)
            first = foreign_episodes(given, format, mode)
        is_stored = writer is None and kind is None
        if codec is not None and not is_stored:
            raise ValueError(
                "codec: the writer decides how frames are stored; leave codec out, or pass a path of another format"
            )
        begun = stored_policy(path, format) if is_stored and path is not None and mode in ("append", "resume") else ""
        # A policy of the user may learn between collections: its weights are compared if the dataset was begun with them.
        learns = (mode == "append" or bool(begun)) and is_overridden(policy, "get_action") and ",weights=" not in begun
        recorded, problem = collected_policy(policy, self, is_stored=is_stored, with_weights=not learns)
        if begun and recorded != begun and _without_weights(recorded) == _without_weights(begun):
            raise ValueError(
                f"World.collect: mode={mode!r}: the dataset records policy {begun}, and this is policy {recorded}; they "
                "differ in their weights; for a policy that learns, take a class of your own with get_action and begin the "
                "dataset with mode='append' as well, which records no weights of it, or collect into another dataset"
            )
        wrappers, unknown = wrapper_records(self, policy) if is_stored else ([], None)
        problem = ", ".join(filter(None, (problem, unknown)))
        config: dict[str, Any] = {
            "episodes": episodes,
            "seed": _seed(seed),
            "variation": _options.variation(_without_states(options), self.spec["variation"]),
            "policy": recorded,
            "action_noise": action_noise or float(getattr(policy, "action_noise", 0.0)),
            "goal": bool(goal),
            "first": first,
            "strict_finite": bool(strict_finite),
            "wrappers": wrappers,
        }
        if not is_stored:
            from ..data.format import open_foreign, writing

            if kind is not None:
                # Last, because a writer that replaces a dataset may delete it at once.
                writer = open_foreign(kind, given, "append" if mode == "resume" else mode)
            config["episodes"] = max(episodes - first, 0) if mode == "resume" else episodes
            with writing(writer, "write_episode") as opened:
                counts = self._collect(policy, None, opened, None, "create", None, config, progress)
            return {**counts, "episodes": first + counts["episodes"]}
        assert path is not None
        if mode == "append" or (mode == "resume" and problem):
            stored = _engine.World.stored(path, format) or 0
            if stored and problem:
                raise ValueError(
                    f"World.collect: mode={mode!r} continues a dataset with the policy and the wrappers that it records, and "
                    f"these cannot be recorded: {problem}; use a class, or functools.partial of one with plain values, in "
                    "their place, or collect into another dataset"
                )
            config["episodes"] += stored if mode == "append" else 0
        engine_mode = {"error": "create", "resume": "append"}.get(mode, mode)
        return self._collect(policy, path, None, format, engine_mode, codec, config, progress)

    def _collect(
        self,
        policy: Any,
        path: str | None,
        writer: Any,
        format: str | None,
        mode: str,
        codec: str | None,
        config: dict[str, Any],
        progress: bool,
    ) -> dict[str, int]:
        from ..data.writer import codec_json

        stored_as, given = codec_json(codec, format=format), _options.as_json("World.collect", config)
        try:
            with _progress.bar("collect", config["episodes"], progress) as bar:
                outcome = self._world.collect(self._playing(policy), path, writer, format, mode, stored_as, given, bar)
        finally:
            self._end_interactive_loop()
        *counts, warning = outcome
        if warning is not None:
            warnings.warn(warning, stacklevel=3)
        return dict(zip(("episodes", "added", "steps"), counts, strict=True))

    def evaluate(
        self,
        episodes: int | None = None,
        seed: int | None = None,
        options: Mapping[str, Any] | None = None,
        video: str | os.PathLike[str] | None = None,
        reset_mode: str | None = None,
        dataset: Any = None,
        episodes_idx: Sequence[int] | None = None,
        start_steps: Sequence[int] | None = None,
        goal_offset: int | None = None,
        eval_budget: int | None = None,
        callables: Any = None,
        *,
        policy: Any = None,
        protocol: str = "strict",
        hold: int = 1,
        floor: bool = True,
        videos: int | None = None,
        condition: str | None = None,
        progress: bool = True,
    ) -> Metrics:
        """Measures the success rate of the policy, and of the random policy on the same starts.

        Args:
            episodes: The number of episodes; 50, or the length of `episodes_idx`, for `None`.
            seed: The seed of starts, goals, factors and plans; random for `None`.
            options: Factors to sample (`variation`) and to pin (`variation_values`). `variation` replaces the factors that a
                reset samples by itself, such as the start: name these as well, or all episodes start alike.
            video: A folder for videos of the first episodes, with their first frames as PNG files beside them. Files of the
                same names are replaced, and those of an earlier evaluation with more videos stay. `swm report` shows videos in
                the folder of the saved results, or below.
            dataset: The dataset of starts and goals: a `swm.data.Dataset`, its path, URI or name.
            episodes_idx, start_steps: The episodes and steps of the dataset to start from; chosen by the seed for `None`.
            goal_offset: The number of steps from a start to its goal; 25 for `None`.
            eval_budget: The time limit of an episode in steps. `None` uses the world's time limit, or 50 with a dataset.
            callables: The methods that set an environment's recorded state, called in this order after its reset:
                `{"method": NAME, "args": {KEYWORD: {"value": COLUMN}}}`. A column name with the prefix `goal_` reads the
                row of the goal. `{"value": ANYTHING, "in_dataset": False}` passes the value itself. The default is
                `set_state(state)` and `set_goal_state(goal_state)`, with or without a leading `_`. Native environments
                restore recorded states without callables.
            policy: The policy to set first; `None` keeps the policy of `set_policy`.
            protocol: `"strict"` leaves out episodes that are solved at start and requires a satisfied goal;
                `"compat"` counts as the Python package stable-worldmodel 0.1.1 does.
            hold: Consecutive steps that must satisfy the goal (with `"strict"`).
            floor: Whether to evaluate the random policy on the same starts.
            videos: The number of episodes to record with `video`; all for `None`.
            condition: A description of the distribution shift, for reports; the factors and visual wrappers for `None`.
            progress: Whether to show progress.

        Returns:
            The metrics.
        """
        if reset_mode not in (None, "auto", "wait"):
            raise ValueError(f"reset_mode: {reset_mode!r}; expected 'auto' or 'wait', which have the same effect")
        if protocol not in ("strict", "compat"):
            raise ValueError(f"protocol: {protocol!r}; expected 'strict' or 'compat'")
        policy = self._chosen(policy)
        picks = None
        if dataset is not None:
            dataset = _stored_path(dataset)
            goal_offset = 25 if goal_offset is None else _options.count("goal_offset", goal_offset)
            eval_budget = 50 if eval_budget is None else _options.count("eval_budget", eval_budget)
            if (episodes_idx is None) != (start_steps is None):
                raise ValueError("episodes_idx, start_steps: give both or neither")
            if episodes_idx is not None and start_steps is not None:
                picks = _options.starts(episodes_idx, start_steps)
                if episodes is not None and _options.count("episodes", episodes) != len(picks):
                    raise ValueError(
                        f"episodes: {episodes!r}; expected {len(picks)}, the length of episodes_idx, or leave it out"
                    )
                episodes = len(picks)
        elif episodes_idx is not None or start_steps is not None or goal_offset is not None:
            raise ValueError("episodes_idx, start_steps, goal_offset: they select rows of a dataset; pass dataset=…")
        if videos is not None and video is None:
            raise ValueError("videos: no folder is named; pass video=… as well")
        videos = None if videos is None else _options.count("videos", videos, 0)
        episodes = 50 if episodes is None else _options.count("episodes", episodes)
        hold = _options.count("hold", hold)
        if hold != 1 and protocol == "compat":
            problem = "with the compat protocol, one step that satisfies the goal ends an episode"
            raise ValueError(f"hold: {hold}; {problem}; leave it out, or use protocol='strict'")
        if callables and dataset is None:
            warnings.warn("callables: without a dataset there are no recorded states to set; none is called", stacklevel=2)
        variation = _options.variation(_without_states(options), self.spec["variation"])
        config = {
            "episodes": episodes,
            "seed": _seed(seed),
            "variation": variation,
            "condition": condition or _describe(variation, wrapper_words(self)),
            "budget": eval_budget,
            "counting": {"strict": {"hold": hold}} if protocol == "strict" else {"compat": {"envs": self.num_envs}},
            "picks": picks,
            "goal_offset": goal_offset or 0,
            "callables": self._callables(_options.callables(callables)) if dataset is not None else [],
        }
        acting: list[tuple[str, Any]] = [(policy_name(policy, self), self._playing(policy))]
        if floor and acting[0][0] != "random":
            acting.append(("random", _engine.Actor.random(self._world, None)))
        # Before the episodes, because they may change the policy and the wrappers.
        manifest = evaluation_manifest(self, policy, config, acting, dataset)
        runs: list[dict[str, Any]] = []
        folder = None
        try:
            for name, actor in acting:
                recording = None
                if video is not None and not runs:
                    folder = _files.local("video", video)
                    folder.mkdir(parents=True, exist_ok=True)
                    recording = [str(folder), "episode", episodes if videos is None else videos]
                given = _options.as_json("World.evaluate", {**config, "policy": name, "videos": recording})
                with _progress.bar(f"evaluate {name}", episodes, progress) as bar:
                    runs.append(json.loads(self._world.evaluate(actor, given, dataset, bar)))
        finally:
            self._end_interactive_loop()
        if hasattr(policy, "plans"):
            policy.plans = json.loads(acting[0][1].take_plans())
        return Metrics._of(manifest, runs, folder)

    def _callables(self, callables: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """The callables for the engine; an empty list for native environments, which do not need them."""
        if not self._native:
            return callables
        ignored = sorted({call["method"] for call in callables} - {"_set_state", "_set_goal_state", "set_state"})
        if ignored:
            name = self.env_name.partition(",")[0]
            warnings.warn(f"callables: {name} restores recorded states itself; {ignored} are not called", stacklevel=3)
        return []

    def _chosen(self, policy: Any) -> Any:
        if policy is not None and policy is not self.policy:
            self.set_policy(policy)
        if self.policy is None:
            raise RuntimeError("World: no policy; call set_policy, or give policy=…")
        return self.policy

    def _end_interactive_loop(self) -> None:
        """Makes the next interactive loop start with a reset, after a collection or an evaluation."""
        self.seed = None
        self._actors.clear()


def _groups(key: str) -> list[str]:
    """The groups that contain a factor: `a` and `a.b` for `a.b.c`."""
    parts = key.split(".")
    return [".".join(parts[:end]) for end in range(1, len(parts))]


def _literal(value: Any) -> Any:
    """A text in quotes where the id of an environment would read it as something else, such as `"5"` as a number."""
    if not isinstance(value, str):
        return value
    try:
        ast.literal_eval(value)
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        is_text = value not in ("true", "false", "none") and not any(sign in value for sign in ",'\"()[]{}")
        return value if is_text else repr(value)
    return repr(value)


def _stored_path(dataset: Any) -> str:
    """The path, URI or name of a dataset whose rows evaluations start from."""
    path = getattr(dataset, "path", dataset)
    if not isinstance(path, (str, os.PathLike)):
        raise TypeError(
            f"dataset: {type(dataset).__name__}; expected a dataset of swm.data.load_dataset in a format of the engine, or its "
            "path, URI or name: evaluations start from rows of one stored dataset; store it with swm.data.convert"
        )
    from ..data.dataset import StoredDataset
    from ..data.foreign import ROWS, check_overrides
    from ..data.format import detect_user_format
    from ..data.utils import resolve

    kind = None if isinstance(dataset, StoredDataset) else detect_user_format(path)
    if kind is not None:
        raise ValueError(
            f"dataset: {os.fspath(path)} has the user-defined format {kind.name!r}; expected a format of the engine, which "
            "reads the rows of starts; store it in one with swm.data.convert"
        )
    check_overrides("World.evaluate", dataset, "write what it returns into a dataset, and pass that one", ROWS)
    if isinstance(dataset, StoredDataset):
        # The evaluation opens the path again, where there may be another dataset by now.
        dataset.check_unchanged()
    text = os.fspath(path)
    # A dataset of this machine counts before one of the hub. Results name the commit of the latter.
    return resolve(text) if text.startswith("lerobot://") else _engine.pinned_dataset(text)


def _random_seed() -> int:
    """A random seed of 32 bits."""
    return secrets.randbits(32)


def _seed(seed: int | None) -> int:
    """The seed, or a random one for `None`."""
    if seed is None:
        return _random_seed()
    return _options.count("seed", seed, least=0)


def _seed_of(episode: int, seed: int, first: Sequence[int]) -> int:
    """The environment's seed of an episode since a reset with a seed, and with the seeds of the first episodes, if given."""
    return first[episode] if episode < len(first) else _engine.World.episode_seed(seed, episode)


def _joined(seeds: Sequence[int]) -> int:
    """One seed for what the seeds of the environments do not state: policies, and the episodes after the first ones."""
    digest = hashlib.sha256(repr(list(seeds)).encode()).digest()
    return int.from_bytes(digest[:4], "little")


def _reference(policy: Any, actors: dict[int, tuple[Callable[[], Any], Any, Any]]) -> Callable[[], Any]:
    """A reference to a policy, at whose end its actor leaves `actors`: an actor may hold a model of gigabytes."""
    key = id(policy)

    def end(reference: weakref.ref[Any]) -> None:
        # Another policy may have the same id since.
        if key in actors and actors[key][0] is reference:
            del actors[key]

    return weakref.ref(policy, end)


def _without_weights(policy: Any) -> str:
    """The record of a policy without the hash of its torch modules."""
    return re.sub(r",weights=torch-sha256-\w+", "", str(policy))


def _without_states(options: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    """The options of many episodes, checked to contain no fixed state or goal state."""
    fixed = [name for name in ("state", "goal_state") if (options or {}).get(name) is not None]
    if fixed:
        raise ValueError(f"options: {fixed} would apply to every episode; pass them to World.reset")
    return options


def _describe(variation: Mapping[str, Any], wrappers: Sequence[str]) -> str:
    """The name of a condition: its factors and wrappers."""
    pinned = [f"{key} = {value}" for key, value in variation["variation_values"].items()]
    return ", ".join([*(variation["variation"] or []), *pinned, *wrappers]) or "in distribution"
