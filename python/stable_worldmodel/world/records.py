"""What the manifests of datasets and results record of policies and environments: all that decides actions and frames.

A collection is continued, and runs are compared, only where these records are equal.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import sys
import types
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit
from urllib.request import url2pathname

import numpy as np

from .. import _engine
from .._overrides import engine_part, is_overridden
from .settings import Unrecorded, flat, is_of_package, modules_hash, named, qualified, short

if TYPE_CHECKING:
    from .world import World

__all__ = [
    "collected_policy",
    "evaluation_manifest",
    "policy_name",
    "stored_policy",
    "weights_hash",
    "wrapper_records",
    "wrapper_words",
]

#: The names of policies that the engine knows in every environment, and the kinds of this package's policies.
_RESERVED = {"random", "expert", "no-op", "replay", "nearest", "mixture", "feed_forward", "world_model"}

#: The content hashes of the datasets that evaluations of this process started from, with the state of their files, by path.
_HASHES: dict[str, tuple[tuple[tuple[str, int, int], ...], str]] = {}


# Policies.


def policy_name(policy: Any, world: World) -> str:
    """The name of a policy in manifests and results: its `type`, or the name of its class.

    Names of policies of the engine belong to these: a policy of the user that takes one is named by its class.
    """
    kind = getattr(policy, "type", None)
    made = type(policy)
    acts_otherwise = is_overridden(policy, "get_action")
    if not acts_otherwise and kind == _own_kind(policy):
        return str(kind)
    reserved = _RESERVED | _experts(world.env_name)
    # A subclass that acts otherwise is not of the kind that it inherits.
    stated = next((base for base in made.__mro__ if "type" in vars(base)), None)
    inherits = "type" not in getattr(policy, "__dict__", {}) and is_of_package(stated)
    if kind in (None, "", "base") or str(kind) in reserved or (inherits and acts_otherwise):
        return qualified(made) if made.__name__ in reserved else made.__name__
    return str(kind)


def collected_policy(policy: Any, world: World, *, is_stored: bool, with_weights: bool = True) -> tuple[Any, str | None]:
    """What the manifest of a dataset records of a policy: its name and settings, or the list of a mixture.

    The engine adds the hash of the weights of a checkpoint that it plays; those of other models are in the text. A collection
    that is not stored, which a training may make at every step, has no manifest: only the name is returned.

    Args:
        policy: The policy.
        world: The world.
        is_stored: Whether the collection has a manifest.
        with_weights: Whether the weights of other models are recorded.

    Returns:
        The record, and what of the policy cannot be recorded, in words.
    """
    if not is_overridden(policy, "get_action") and getattr(policy, "_choice", None):
        return policy._choice, None
    name, problem = policy_name(policy, world), None
    if not is_stored:
        return name, None
    try:
        settings = policy_settings(policy, world)
        by_engine = _plays_checkpoint(policy) and not world._infos_differ
        if with_weights and not by_engine and (weights := weights_hash(policy)) is not None:
            settings["weights"] = weights
    except Exception as error:
        problem = _reason(policy, error)
        settings = {"unrecorded": problem}
    kind = _own_kind(policy)
    if kind not in (None, name) and name != str(getattr(policy, "type", None)) and not is_overridden(policy, "get_action"):
        settings["kind"] = kind
    # No colon: `swm collect` reads what follows the last one as the weight of a policy.
    words = [f"{key}={value}".replace(":", ";") for key, value in flat(settings)]
    return ",".join([name, *words]), problem


def _reason(policy: Any, error: Exception) -> str:
    """Why a policy cannot be recorded, which is never an error of a collection or an evaluation."""
    return str(error) if isinstance(error, Unrecorded) else f"{type(policy).__name__} ({type(error).__name__}: {error!s:.100})"


def stored_policy(path: str, format: str | None) -> str:
    """The policy that the manifest of a dataset records; empty if there is no dataset, or it records none."""
    from ..data.utils import load_dataset

    if not _engine.World.stored(path, format):
        return ""
    manifest = load_dataset(_engine.target(path, format), format=format).manifest or {}
    policy = (manifest.get("config") or {}).get("policy")
    return policy if isinstance(policy, str) else ""


def evaluation_manifest(
    world: World, policy: Any, config: Mapping[str, Any], acting: Sequence[tuple[str, Any]], dataset: str | None
) -> dict[str, Any]:
    """The manifest of the results of an evaluation.

    Policies, starts, time limit, frames and hashes have the names that `swm eval` gives them, by which `swm report` decides
    which runs it compares. There is no `version`: the engine cannot play an evaluation of Python again.

    Args:
        world: The world.
        policy: The policy.
        config: The settings of the evaluation, as the engine gets them.
        acting: The names of the runs with the engine's actors: the policy, and `random` if the random-policy floor is played.
        dataset: The dataset of the starts.
    """
    (name, actor), *others = acting
    entry, weights = _evaluated_policy(policy, world, name, actor.weights)
    wrappers, _ = wrapper_records(world, policy)
    entries = [{"name": name, "acts": "random"} for name, _ in others]
    hashes = {} if weights is None else {f"weights of {name}": weights}
    starts: Any = "episodic"
    if dataset is not None:
        if warning := _engine.warning_of_starts(dataset, world.env_name):
            warnings.warn(warning, stacklevel=3)
        # The engine says what is wrong with a dataset that cannot be read.
        with contextlib.suppress(Exception):
            hashes["dataset"] = _content_hash(dataset)
        starts = {"dataset": dataset, "goal_offset": config["goal_offset"], "held_out": None}
        starts = {"dataset": starts | ({"callables": config["callables"]} if config["callables"] else {})}
    recorded = {
        **config,
        "env": world.env_name,
        "num_envs": world.num_envs,
        "dataset": dataset,
        "front": "python",
        "budget": config["budget"] or world.max_episode_steps,
        "starts": starts,
        # A wrapper in Python may change any action on its way.
        "policies": [one | ({"wrappers": wrappers} if world._wrapped_in_python else {}) for one in (*entries, entry)],
        "image": None if world._image is None else list(world._image),
        "wrappers": wrappers,
        "wrap_goal": world._wrap_goal,
    }
    return {
        "kind": "evaluate",
        "swm_version": _engine.__version__,
        "libraries": json.loads(world._world.libraries()),
        "seed": config["seed"],
        "config": recorded,
        "hashes": hashes,
        "device": "cpu",
    }


def _content_hash(name: str) -> str:
    """The content hash of a dataset, which is computed again only after a change of its files.

    Most formats read the whole dataset to compute it, and a training evaluates many times on the same one. Of a dataset in an
    object store the files are not known, so its hash is computed at each evaluation.
    """
    from ..data.utils import inspect, load_dataset

    dataset = load_dataset(name)
    location = str(getattr(dataset, "path", name))
    root = Path(url2pathname(urlsplit(location).path) if location.startswith("file://") else location)
    below = sorted(os.path.join(folder, file) for folder, _, files in os.walk(root) for file in files)
    files = below or [str(root)] * root.is_file()
    state = tuple((file, found.st_size, found.st_mtime_ns) for file in files for found in (os.stat(file),))
    known = _HASHES.get(str(root))
    if known is None or not state or known[0] != state:
        known = _HASHES[str(root)] = (state, str(inspect(dataset)["content_hash"]))
    return known[1]


def _evaluated_policy(policy: Any, world: World, name: str, loaded: str | None) -> tuple[dict[str, Any], str | None]:
    """The entry of a policy in the manifest of results, and the hash of its weights; `loaded` is that of the engine's actor.

    Settings that cannot be recorded are named. Results are compared nevertheless, because one policy is usually evaluated
    several times.
    """
    kind = _own_kind(policy)
    is_own = kind is None or is_overridden(policy, "get_action")
    weights, choice = None, None if is_own else getattr(policy, "_choice", None)
    try:
        settings = policy_settings(policy, world)
        # The files of a checkpoint may have been replaced since the engine loaded it.
        weights = loaded if loaded is not None and _plays_checkpoint(policy) else weights_hash(policy)
        models = {one["name"] for one in choice or ()} - _RESERVED - (_experts(world.env_name) if choice else set())
        choice = [{**one, "weights": _checkpoint_hash(one["name"])} if one["name"] in models else one for one in choice or ()]
    except Exception as error:
        settings = {"unrecorded": _reason(policy, error)}
    if is_own:
        return {"name": name, "acts": {"python": {"class": qualified(type(policy)), **settings}}}, weights
    if name == "random":
        # The engine knows the floor by this word.
        return {"name": name, "acts": "random", **settings}, weights
    if choice:
        return {"name": name, "acts": {"mixture": choice, **settings}}, weights
    if _is_expert(policy):
        return {"name": name, "acts": {"expert": {"id": kind, **settings}}}, weights
    return {"name": name, "acts": {kind: settings}}, weights


def policy_settings(policy: Any, world: World) -> dict[str, Any]:
    """The settings of a policy that decide its actions, beside the weights of its model.

    Raises:
        Unrecorded: When one cannot be recorded.
    """
    from ..policy import FeedForwardPolicy, MPCPolicy

    found: dict[str, Any] = {}
    seed = getattr(policy, "seed", None)
    own = hasattr(policy, "_actor") and not is_overridden(policy, "get_action")
    if own and isinstance(seed, (int, np.integer)) and not isinstance(seed, bool):
        found["seed"] = int(seed)
    solver = getattr(policy, "solver", None) if isinstance(policy, MPCPolicy) else None
    model = getattr(policy, "model", None) if isinstance(policy, FeedForwardPolicy) else getattr(solver, "model", None)
    if solver is None and (model is None or not isinstance(policy, FeedForwardPolicy)):
        # That of `swm.envs.dmcontrol.ExpertPolicy`.
        noise = getattr(policy, "noise_std", None) if is_of_package(type(policy)) else None
        return {**found, "noise_std": float(noise)} if noise else found
    if solver is not None:
        found["solver"] = getattr(solver, "id", None) if is_of_package(type(solver)) else qualified(type(solver))
        if is_overridden(solver, "solve"):
            found["solver"] = qualified(type(solver))
        settings = solver._all_settings() if callable(getattr(solver, "_all_settings", None)) else None
        given = {**(settings or {}), **(getattr(solver, "_given", None) or {})}
        found |= {"settings": named("the solver's settings", given), "plan": _plan(policy.cfg)}
        if isinstance(getattr(solver, "seed", None), (int, np.integer)):
            found["seed"] = int(solver.seed)
        if policy.history_keys != ("pixels",) and policy.cfg.history_len > 1:
            found["history_keys"] = named("history_keys", policy.history_keys)
    if not _plays_checkpoint(policy):
        found["model"] = model if isinstance(model, str) else qualified(type(model))
    if solver is not None:
        found |= _cost_settings(model)
    for name in ("process", "transform"):
        if value := getattr(policy, name, None):
            found[name] = named(name, value)
    return found


def _plan(config: Any) -> Any:
    return named("the plan", asdict(config) if is_dataclass(config) and not isinstance(config, type) else config)


def _cost_settings(model: Any) -> dict[str, Any]:
    """The objective of a model that is planned in, and how its goals are encoded, as far as it has them."""
    arguments = getattr(model, "_arguments", None)
    if isinstance(arguments, tuple):
        # A checkpoint of the engine: name, device, objective, trust.
        return {} if arguments[2] is None else {"objective": named("the objective", arguments[2])}
    evaluator = sys.modules.get("stable_worldmodel.planning.evaluator")
    if evaluator is None or not isinstance(model, evaluator.ShootingCostEvaluator):
        return {}
    parts = ("objective", "constraints", "encode_goal")
    return {"evaluates": qualified(type(model.model)), **{name: named(name, getattr(model, name)) for name in parts}}


def weights_hash(policy: Any) -> str | None:
    """The hash of the weights of a policy; `None` for one without weights.

    Checkpoints of the engine have the hash that the engine writes. That of torch modules begins with `torch-sha256-`: it is of
    the names, shapes, types and bytes of the state dict.

    Raises:
        Unrecorded: When the weights cannot be read.
    """
    from ..policy import FeedForwardPolicy, MPCPolicy

    model = getattr(policy, "model", None) if isinstance(policy, FeedForwardPolicy) else None
    if isinstance(policy, MPCPolicy):
        model = getattr(getattr(policy, "solver", None), "model", None)
    if isinstance(model, str):
        # The name of the simulator, or a text of a user's policy or solver, is no checkpoint.
        return _checkpoint_hash(model) if _plays_checkpoint(policy) else modules_hash(policy)
    card = getattr(model, "card", None)
    if isinstance(card, Mapping) and isinstance(card.get("weights"), str):
        return str(card["weights"])
    return modules_hash(policy if model is None or is_overridden(policy, "get_action") else model)


def _checkpoint_hash(name: str) -> str:
    from .. import wm

    return str(wm.load(name).card["weights"])


def _own_kind(policy: Any) -> str | None:
    """The kind of a policy of this package, whatever name it was given; `None` for a policy of the user."""
    if _is_expert(policy):
        return str(getattr(policy, "name", "expert"))
    base = next((base for base in type(policy).__mro__ if is_of_package(base) and "type" in vars(base)), None)
    kind = None if base is None else vars(base)["type"]
    return None if kind == "base" else kind


def _is_expert(policy: Any) -> bool:
    from ..policy import ExpertPolicy

    return isinstance(policy, ExpertPolicy)


@functools.lru_cache(64)
def _experts(env_name: str) -> frozenset[str]:
    """The experts of an environment, of which the zoo has some."""
    return frozenset(_engine.Actor.experts(env_name) if env_name.partition(",")[0] in _engine.envs() else ())


def _plays_checkpoint(policy: Any) -> bool:
    """Whether this is a checkpoint of the engine that acts, whose weights the engine records by itself."""
    from ..policy import FeedForwardPolicy

    if not isinstance(policy, FeedForwardPolicy) or is_overridden(policy, "get_action"):
        return False
    return isinstance(policy.model, str) or engine_part(policy.model, "_engine_policy", "get_action") is not None


# Environments.


def wrapper_records(world: World, policy: Any) -> tuple[list[dict[str, Any]], str | None]:
    """The wrappers of a world, and its settings that change what policies and datasets get.

    Wrappers in Python have ids `python:MODULE.CLASS`, and the settings of the world the id of its class. `swm collect` does not
    continue a collection with either. They are described once, before they act, because some change while they do, such as
    one that counts.

    Returns:
        The records, and what cannot be recorded, in words.
    """
    if world._recorded is None:
        python = [_wrapper(factory) for factory in (world._wrappers if world._wrapped_in_python else ())]
        given = {"image_transform": world.transforms.image, "goal_transform": world.transforms.goal}
        world._recorded = (
            [(f"python:{id}", *_described(f"the wrapper {id}", settings)) for id, settings in python],
            {name: _described(name, function) for name, function in given.items() if function is not None},
        )
    wrappers, transforms = world._recorded
    # The engine's own policies get the frames themselves.
    transforms = transforms if _gets_transforms(policy) else {}
    found: list[dict[str, Any]] = [{"id": id, "settings": settings} for id, settings in world._wrapping]
    own: dict[str, Any] = {"wrap_goal": True} if world._wrap_goal and found else {}
    found += [{"id": id, "settings": settings} for id, settings, _ in wrappers]
    own |= {} if world._resampled is None else {"image_resample": world._resampled}
    own |= {name: settings for name, (settings, _) in transforms.items()}
    found += [{"id": "python:stable_worldmodel.World", "settings": own}] if own else []
    problems = [*(problem for *_, problem in wrappers), *(problem for _, problem in transforms.values())]
    return found, ", ".join(filter(None, problems)) or None


def _described(name: str, value: Any) -> tuple[Any, str | None]:
    """The record of a setting, and why there is none."""
    try:
        return short(named(name, value)), None
    except Unrecorded as error:
        return {"unrecorded": str(error)}, str(error)


def wrapper_words(world: World) -> list[str]:
    """The wrappers that run in the engine as `swm eval` names them in conditions, such as `noise,std=8`."""
    return [",".join([id, *(f"{key}={value}" for key, value in flat(settings))]) for id, settings in world._wrapping]


def _gets_transforms(policy: Any) -> bool:
    """Whether a policy gets the frames of `image_transform` and `goal_transform`."""
    from ..policy import ExpertPolicy, MixturePolicy, RandomPolicy

    return not isinstance(policy, (ExpertPolicy, MixturePolicy, RandomPolicy)) or is_overridden(policy, "get_action")


def _wrapper(factory: Callable[..., Any]) -> tuple[str, dict[str, Any]]:
    """The name of a wrapper that runs in Python, and its settings."""
    values: tuple[Any, ...] = ()
    settings: dict[str, Any] = {}
    made: Any = factory
    while isinstance(made, functools.partial):
        values, settings, made = made.args + values, {**made.keywords, **settings}, made.func
    what = made if isinstance(made, (type, types.FunctionType)) else type(made)
    if values:
        settings["*"] = list(values)
    if not isinstance(made, type):
        settings["made by"] = made
    return qualified(what), settings
