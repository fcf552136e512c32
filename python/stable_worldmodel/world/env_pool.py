"""`EnvPool`: Gymnasium environments that are stepped one after another, with their infos as one batch."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space, iterate

from .. import spaces as swm_spaces
from .._action_spaces import batched
from .._lazy import lazy
from ..data import _tensors

if TYPE_CHECKING:
    from .world import World

__all__ = ["EnvPool", "WorldEnvs", "chosen"]

#: An entry that the info of an environment lacks.
_MISSING: Any = object()


class EnvPool:
    """Gymnasium environments that are stepped one after another, in this interpreter, with their infos as one batch.

        pool = EnvPool([lambda: MegaWrapper(gymnasium.make("swm/PushT-v1", render_mode="rgb_array"))] * 2)
        _, infos = pool.reset(seed=0)
        _, rewards, terminateds, truncateds, infos = pool.step(pool.action_space.sample())

    `World` steps its environments in parallel; use a pool where your own code steps environments.

    Args:
        env_fns: Functions without arguments that create the environments.

    Infos are one dict for all environments, which every step overwrites: arrays and tensors `(num_envs, 1, ..)`, and lists
    `[[value], ..]` of other values. The columns are those of the last reset of all environments. A missing entry repeats
    the last value of the episode; before its first, it is 0, or `None` in a list.
    """

    def __init__(self, env_fns: Sequence[Callable[[], Any]]) -> None:
        #: The environments.
        self.envs: list[Any] = [create() for create in env_fns]
        if not self.envs:
            raise ValueError("EnvPool: no environments; expected functions that create them")
        #: The seeds of the last resets; -1 for those without one.
        self.seeds: np.ndarray = np.full(len(self.envs), -1, np.int64)
        #: The number of resets of every environment, by which policies find out that an episode began.
        self._resets: np.ndarray = np.zeros(len(self.envs), np.int64)
        self._infos: dict[str, Any] | None = None

    @property
    def num_envs(self) -> int:
        """The number of environments."""
        return len(self.envs)

    @property
    def single_action_space(self) -> spaces.Space[Any]:
        """The action space of one environment."""
        space: spaces.Space[Any] = self.envs[0].action_space
        return space

    @lazy
    def action_space(self) -> spaces.Space[Any]:
        """The action space of all environments together."""
        return batched(self.single_action_space, self.num_envs)

    @property
    def single_observation_space(self) -> spaces.Space[Any]:
        """The observation space of one environment."""
        space: spaces.Space[Any] = self.envs[0].observation_space
        return space

    @lazy
    def observation_space(self) -> spaces.Space[Any]:
        """The observation space of all environments together."""
        return batch_space(self.single_observation_space, self.num_envs)

    @property
    def variation_space(self) -> Any:
        """The factors of variation, with the values of the first environment; `None` if the environments have none."""
        return getattr(self.envs[0].unwrapped, "variation_space", None)

    @property
    def single_variation_space(self) -> Any:
        """The factors of variation, as `variation_space`."""
        return self.variation_space

    def reset(
        self,
        seed: int | Sequence[int | None] | None = None,
        options: Mapping[str, Any] | Sequence[Mapping[str, Any] | None] | None = None,
        mask: Sequence[bool] | np.ndarray | None = None,
    ) -> tuple[None, dict[str, Any]]:
        """Starts episodes.

        Args:
            seed: Environment `i` resets with `seed + i`; a list holds one seed for each environment.
            options: The options of resets; a list holds those of each environment.
            mask: The environments to reset; the other ones keep their infos.

        Returns:
            `None` in place of observations, and the infos.
        """
        count = self.num_envs
        if isinstance(seed, (int, np.integer)):
            seeds: list[Any] = [int(seed) + env for env in range(count)]
        else:
            seeds = [None] * count if seed is None else list(seed)
        given = list(options) if isinstance(options, Sequence) else [options] * count
        for what, values in (("seed", seeds), ("options", given)):
            if len(values) != count:
                raise ValueError(f"{what}: expected {count} values, one for each environment, got {len(values)}")
        started: dict[int, dict[str, Any]] = {}
        for env in self._chosen(mask):
            _, started[env] = self.envs[env].reset(seed=seeds[env], options=given[env])
            self._resets[env] += 1
            self.seeds[env] = -1 if seeds[env] is None else seeds[env]
        if len(started) == count:
            infos = [started[env] for env in range(count)]
            keys = dict.fromkeys(key for info in infos for key in info)
            self._infos = {key: _column(key, [info.get(key, _MISSING) for info in infos]) for key in keys}
        elif self._infos is None:
            raise ValueError("mask: the first reset must be one of all environments")
        else:
            for env, info in started.items():
                self._clear(env, self._infos.keys() - info.keys())
                self._write(env, info)
        return None, self._known()

    def step(
        self, actions: Any, mask: Sequence[bool] | np.ndarray | None = None
    ) -> tuple[None, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Steps environments.

        Args:
            actions: One action for each environment, or an element of `action_space`: for a `Dict` or `Tuple` space, its arrays
                have one row for each environment.
            mask: The environments to step. The other ones keep their infos, and have no reward and no end of an episode.

        Returns:
            `None` in place of observations, the rewards, whether episodes were terminated and truncated, and the infos.
        """
        rewards = np.zeros(self.num_envs, np.float32)
        terminateds, truncateds = np.zeros((2, self.num_envs), bool)
        self._known()
        if _is_batch(self.single_action_space, actions, self.num_envs):
            actions = list(iterate(self.action_space, actions))
        elif isinstance(actions, Mapping) or len(actions) != self.num_envs:
            raise ValueError(
                f"actions: expected {self.num_envs} actions, one for each environment, or an element of {self.action_space}, "
                f"got {actions!r}"
            )
        for env in self._chosen(mask):
            _, reward, terminated, truncated, info = self.envs[env].step(actions[env])
            rewards[env] = _reward(reward)
            terminateds[env], truncateds[env] = _flag("terminated", terminated), _flag("truncated", truncated)
            self._write(env, info)
        return None, rewards, terminateds, truncateds, self._known()

    def close(self) -> None:
        """Closes the environments."""
        for env in self.envs:
            env.close()

    def _chosen(self, mask: Any) -> list[int]:
        """The environments that a mask chooses."""
        return np.flatnonzero(chosen(mask, self.num_envs)).tolist()

    def _clear(self, env: int, keys: Iterable[str]) -> None:
        """Sets entries of an environment to what they are before their first value."""
        for key in keys:
            column = self._known()[key]
            if isinstance(column, list):
                column[env][0] = None
            else:
                column[env] = 0

    def _known(self) -> dict[str, Any]:
        if self._infos is None:
            raise RuntimeError("EnvPool: call reset before step")
        return self._infos

    def _write(self, env: int, info: Mapping[str, Any]) -> None:
        columns = self._known()
        for key in info.keys() & columns.keys():
            column, value = columns[key], info[key]
            if isinstance(column, list):
                column[env][0] = value
                continue
            array, shape, dtype = _tensors.to_numpy(value), tuple(column.shape[2:]), _tensors.to_numpy(column[:1]).dtype
            numbers = dtype.kind in "biuf"
            fits = np.can_cast(array.dtype, dtype, "same_kind" if numbers else "safe")
            if array.shape != shape or not (fits or (array.dtype.kind in "iu" and dtype.kind in "iu")):
                given = f"{array.dtype} of shape {array.shape}"
                raise ValueError(f"info[{key!r}]: got {given}, expected {dtype} of shape {shape} as in the first reset")
            array = _tensors.exact(f"info[{key!r}]", array.reshape(-1), dtype.name).reshape(shape) if numbers else array
            if hasattr(column, "detach"):
                import torch

                column[env, 0] = torch.as_tensor(array, dtype=column.dtype, device=column.device)
            else:
                column[env, 0] = array


def chosen(mask: Any, count: int) -> np.ndarray:
    """Whether a mask chooses each of `count` environments; `None` chooses all.

    Raises:
        ValueError: If it has other values than true and false, or another number of them.
    """
    given = np.ones(count, bool) if mask is None else _tensors.to_numpy(mask)
    if given.shape != (count,) or given.dtype.kind not in "biuf" or not np.isin(given, (0, 1)).all():
        raise ValueError(f"mask: expected {count} values, true or false, one for each environment, got {mask!r}")
    return given.astype(bool)


def _is_batch(space: spaces.Space[Any], actions: Any, count: int) -> bool:
    """Whether actions of a `Dict` or `Tuple` space are an element of the batched space, which holds arrays of `count` rows."""
    if isinstance(space, spaces.Dict):
        return isinstance(actions, Mapping) and all(
            key in actions and _is_rows(part, actions[key], count) for key, part in space.spaces.items()
        )
    if isinstance(space, spaces.Tuple):
        return (
            isinstance(actions, tuple)
            and len(actions) == len(space.spaces)
            and all(_is_rows(part, rows, count) for part, rows in zip(space.spaces, actions, strict=True))
        )
    return False


def _is_rows(space: spaces.Space[Any], rows: Any, count: int) -> bool:
    """Whether this is a part of an element of a batched space."""
    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        return _is_batch(space, rows, count)
    if space.shape is None:
        # Gymnasium batches spaces without a shape, such as `Text`, as tuples.
        return isinstance(rows, tuple) and len(rows) == count
    return not isinstance(rows, (tuple, list)) and np.shape(rows) == (count, *space.shape)


def _reward(value: Any) -> np.float32:
    """A reward in single precision."""
    array = _tensors.to_numpy(value)
    if array.dtype.kind not in "biuf" or array.size != 1:
        raise ValueError(f"reward: {value!r}; expected a number")
    with np.errstate(over="ignore"):
        stored = np.float32(array.item())
    if np.isinf(stored) and np.isfinite(array).all():
        raise ValueError(f"reward: {value!r}; expected a number of single precision, at most 3.4e38")
    return stored


def _flag(name: str, value: Any) -> bool:
    """Whether an episode ended."""
    if np.ndim(value) != 0 or value not in (False, True):
        raise ValueError(f"{name}: {value!r}; expected true or false")
    return bool(value)


def _column(key: str, values: list[Any]) -> Any:
    """The values of the environments as an array or tensor `(num_envs, 1, ..)`, or as a list.

    Raises:
        ValueError: If the values differ in shape, or their common type cannot hold one.
    """
    present = [value for value in values if value is not _MISSING]
    first = present[0]
    if hasattr(first, "detach"):
        import torch

        return torch.stack([torch.zeros_like(first) if value is _MISSING else value for value in values]).unsqueeze(1)
    kinds = (np.ndarray, np.number, np.bool_, bool, int, float)
    arrays = [np.asarray(value) for value in present if isinstance(value, kinds)]
    found = {array.dtype.kind for array in arrays}
    if len(arrays) < len(present) or not (found <= set("biuf") or found in ({"U"}, {"S"})):
        return [[None if value is _MISSING else value] for value in values]
    if any(array.shape != arrays[0].shape for array in arrays):
        shapes = ", ".join(str(array.shape) for array in arrays)
        raise ValueError(f"info[{key!r}]: the environments have values of the shapes {shapes}; expected equal ones")
    dtype = np.result_type(*arrays).name
    zero = np.zeros(arrays[0].shape, dtype)
    stored = [zero if value is _MISSING else np.asarray(value) for value in values]
    if not found <= set("biuf"):
        return np.stack(stored)[:, None]
    exact = [_tensors.exact(f"info[{key!r}]", value.reshape(-1), dtype).reshape(zero.shape) for value in stored]
    return np.stack(exact)[:, None]


class WorldEnvs(EnvPool):
    """The environments of a `World`, as policies get them: their number, their spaces, and single steps."""

    def __init__(self, world: World) -> None:
        self._world = world

    @property
    def num_envs(self) -> int:
        """The number of environments."""
        return self._world.num_envs

    @lazy
    def single_action_space(self) -> spaces.Space[Any]:
        """The action space of one environment."""
        return swm_spaces.from_description(self._world.spec["action_space"])

    @lazy
    def action_space(self) -> spaces.Space[Any]:
        """The action space of all environments together."""
        return batched(self.single_action_space, self.num_envs)

    @lazy
    def single_observation_space(self) -> spaces.Space[Any]:
        """The observation space of one environment."""
        return swm_spaces.from_description(self._world.spec["observation_space"])

    @lazy
    def observation_space(self) -> spaces.Space[Any]:
        """The observation space of all environments together."""
        return batch_space(self.single_observation_space, self.num_envs)

    @lazy
    def variation_space(self) -> swm_spaces.Dict:
        """The factors of variation, with their defaults as values: `World.factors` has those of an environment."""
        return swm_spaces.variation_space(self._world.spec["variation"], self._world.spec["sampling_order"])

    @property
    def single_variation_space(self) -> swm_spaces.Dict:
        """The factors of variation, as `variation_space`."""
        return self.variation_space

    @property
    def envs(self) -> list[Any]:  # type: ignore[override]
        """The Gymnasium environments of this interpreter; empty for native environments and worker processes."""
        return self._world.gym_envs

    def reset(
        self,
        seed: int | Sequence[int | None] | None = None,
        options: Mapping[str, Any] | Sequence[Mapping[str, Any] | None] | None = None,
        mask: Sequence[bool] | np.ndarray | None = None,
    ) -> tuple[None, dict[str, Any]]:
        """As `World.reset`, which starts an episode in every environment."""
        if not chosen(mask, self.num_envs).all():
            raise ValueError("mask: the environments of a World are reset together; World.step resets finished ones")
        self._world.reset(seed, options)  # type: ignore[arg-type]
        return None, self._world.infos

    def step(
        self, actions: Any, mask: Sequence[bool] | np.ndarray | None = None
    ) -> tuple[None, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Steps environments with these actions; see `EnvPool.step`. Finished episodes are not reset."""
        return None, *self._world._step_with(actions, mask), self._world.infos

    def close(self) -> None:
        """Closes the world."""
        self._world.close()

    @property
    def seeds(self) -> np.ndarray:  # type: ignore[override]
        """The seeds of the last resets, `(num_envs,)`."""
        return np.array([self._world._seed_of(episode) for episode in self._world._episodes], dtype=np.int64)
