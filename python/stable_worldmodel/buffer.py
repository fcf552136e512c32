"""`HistoryBuffer`: the latest steps of several environments, for policies that need past observations."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from . import _options

__all__ = ["HistoryBuffer"]


class HistoryBuffer:
    """The latest `max_len` steps of each environment, returned at the cadence of a model's steps.

        buffer = HistoryBuffer(n_envs=2, max_len=5, action_block=2, block_keys=("action",))
        for infos in steps:
            buffer.append(infos)
        history = buffer.get(2)  # pixels of steps t - 2 and t; the actions of the two model steps that ended at t

    Args:
        n_envs: The number of environments.
        max_len: The number of steps that are kept of each environment.
        action_block: Environment steps in one model step.
        block_keys: Columns of which a model step has all values, concatenated, instead of the last one.
    """

    def __init__(self, n_envs: int, max_len: int, action_block: int = 1, block_keys: Iterable[str] = ()) -> None:
        sizes = {"n_envs": n_envs, "max_len": max_len, "action_block": action_block}
        self.n_envs, self.max_len, self.action_block = (
            _options.count(f"HistoryBuffer: {name}", value) for name, value in sizes.items()
        )
        self.block_keys = frozenset(block_keys)
        self._steps: list[deque[dict[str, Any]]] = [deque(maxlen=self.max_len) for _ in range(self.n_envs)]

    def __len__(self) -> int:
        """The number of steps of the environment that has the fewest."""
        return min(map(len, self._steps))

    def append(self, info_dict: Mapping[str, Any]) -> None:
        """Adds a step of every environment.

        Args:
            info_dict: Tensors or arrays `(n_envs, ..)`; other values are ignored.
        """
        columns = {key: value for key, value in info_dict.items() if hasattr(value, "shape")}
        for key, value in columns.items():
            if not len(value.shape) or value.shape[0] != self.n_envs:
                raise ValueError(f"HistoryBuffer: {key!r} has shape {tuple(value.shape)}, expected ({self.n_envs}, ..)")
        for env, steps in enumerate(self._steps):
            # Arrays of a World are overwritten by its next step.
            steps.append({key: _copy(value[env]) for key, value in columns.items()})

    def num_strided(self, env_ids: Sequence[int] | None = None) -> int:
        """The number of model steps that all of these environments (all environments for `None`) have."""
        shortest = min((len(self._steps[env]) for env in self._envs(env_ids)), default=0)
        return (shortest - 1) // self.action_block + 1 if shortest else 0

    def get(self, n: int, env_ids: Sequence[int] | None = None) -> dict[str, Any] | None:
        """The last model steps, oldest first: at most `n`, and no more than every environment has.

        Args:
            n: The number of model steps.
            env_ids: The indices of the environments, B of them, or a mask `(n_envs,)` of booleans; all for `None`.

        Returns:
            Columns `(B, k)` of values `(n_envs,)`, `(B, k * T, ..)` of values `(n_envs, T, ..)`, and with an action block
            `(B, k, action_block * D)` of the columns `block_keys`, in which only whole blocks count. `None` if an environment
            has no step, or `n` is less than 1.

        Raises:
            TypeError: If `env_ids` are neither indices nor a mask.
            ValueError: If an environment does not exist, or a mask has another length. If the steps differ in their columns, or
                in the shapes of a column.
        """
        envs = self._envs(env_ids)
        count = min(int(n), self.num_strided(envs))
        if count < 1:
            return None
        blocks = min(int(n), min(len(self._steps[env]) for env in envs) // self.action_block)
        found: dict[str, Any] = {}
        for key in self._columns(envs, max(1 + (count - 1) * self.action_block, blocks * self.action_block)):
            try:
                if key in self.block_keys and self.action_block > 1:
                    found[key] = _stack([self._blocks(env, key, blocks) for env in envs])
                else:
                    found[key] = _stack([self._strided(env, key, count) for env in envs])
            except (KeyError, ValueError, RuntimeError) as error:
                steps = [step for env in envs for step in self._steps[env]]
                forms = sorted({str(tuple(step[key].shape)) if key in step else "missing" for step in steps})
                if len(forms) == 1:
                    raise
                raise ValueError(
                    f"HistoryBuffer: the steps differ in {key!r} ({', '.join(forms)}); append equal columns, or reset it first"
                ) from error
        return found

    def reset(self, env_ids: Sequence[int] | None = None) -> None:
        """Forgets the steps of these environments, indices or a mask as for `get`; of all of them for `None`."""
        for env in self._envs(env_ids):
            self._steps[env].clear()

    def _envs(self, env_ids: Any) -> list[int]:
        if env_ids is None:
            return list(range(self.n_envs))
        given = env_ids.detach().cpu() if hasattr(env_ids, "detach") else env_ids
        envs = _options.indices("HistoryBuffer: env_ids", given, self.n_envs)
        if envs and max(envs) >= self.n_envs:
            raise ValueError(f"HistoryBuffer: env_ids: {max(envs)}; expected indices from 0 to {self.n_envs - 1}")
        return envs

    def _columns(self, envs: Sequence[int], steps: int) -> list[str]:
        """The columns that any of the last `steps` steps of these environments has."""
        return list(dict.fromkeys(key for env in envs for step in list(self._steps[env])[-steps:] for key in step))

    def _strided(self, env: int, key: str, count: int) -> Any:
        steps = self._steps[env]
        values = [steps[len(steps) - 1 - back * self.action_block][key] for back in range(count - 1, -1, -1)]
        return _stack(values) if not values[0].shape else _concatenate(values)

    def _blocks(self, env: int, key: str, count: int) -> Any:
        values = [step[key].reshape(-1) for step in self._steps[env]]
        last = _stack(values[len(values) - count * self.action_block :] or values[:1])
        return last[: count * self.action_block].reshape(count, self.action_block * values[0].shape[0])


def _copy(value: Any) -> Any:
    return value.clone() if hasattr(value, "clone") else np.array(value)


def _stack(values: Sequence[Any]) -> Any:
    if hasattr(values[0], "clone"):
        import torch

        return torch.stack(list(values))
    return np.stack(values)


def _concatenate(values: Sequence[Any]) -> Any:
    if hasattr(values[0], "clone"):
        import torch

        return torch.cat(list(values))
    return np.concatenate(values)
