"""Converts readers implemented in Python to datasets of the engine, for loading and conversion."""

from __future__ import annotations

import contextlib
import copy
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from contextvars import ContextVar
from typing import Any

from stable_worldmodel import _engine
from stable_worldmodel._forks import fork_lock
from stable_worldmodel._overrides import is_overridden

from . import _tensors
from ._tensors import Array
from .buffer import ReplayBuffer
from .dataset import ConcatDataset, MergeDataset, StoredDataset

__all__ = ["check_overrides", "engine_of", "left_out"]

#: The number of cached slices: a conversion reads the columns of an episode one after another.
_CACHED = 4

#: Where readers note the names of texts and values of episodes, which the engine does not get.
_LEFT_OUT: ContextVar[set[str] | None] = ContextVar("left_out", default=None)


class _Rows:
    """Adapts a reader to the methods that the engine calls: `schema`, `lengths` and `rows`."""

    def __init__(self, reader: Any) -> None:
        # Read stored rows, without frameskip, clips and transform.
        self._reader = copy.copy(reader)
        for name, value in (("frameskip", 1), ("num_steps", 1), ("span", 1), ("transform", None)):
            if hasattr(self._reader, name):
                setattr(self._reader, name, value)
        self._cache: OrderedDict[tuple[int, int, int], dict[str, Array]] = OrderedDict()
        self._lock = fork_lock()
        self._left_out = _LEFT_OUT.get()
        if self._left_out is not None and getattr(reader, "episode_column_names", None):
            self._left_out.add(_tensors.EPISODE)

    def lengths(self) -> list[int]:
        return [int(length) for length in self._reader.lengths]

    def schema(self) -> list[tuple[str, str, list[int]]]:
        lengths = self.lengths()
        episode = next((i for i, length in enumerate(lengths) if length > 0), None)
        if episode is None:
            return []
        first = self._slice(episode, 0, lengths[episode])
        return [(name, array.dtype.name, list(array.shape[1:])) for name, array in first.items()]

    def rows(self, column: str, episode: int, start: int, length: int) -> Array:
        return self._slice(episode, start, start + length)[column]

    def _slice(self, episode: int, start: int, end: int) -> dict[str, Array]:
        key = (episode, start, end)
        with self._lock:
            if key in self._cache:
                return self._cache[key]
        if hasattr(self._reader, "_load_slice"):
            found = self._reader._load_slice(episode, start, end)
        else:
            content = self._reader.load_episode(episode)
            whole = (str, bytes, Mapping)
            found = {name: value if isinstance(value, whole) else value[start:end] for name, value in content.items()}
        # A slice has one action for each row, also for the last row of an episode.
        arrays, constants = _tensors.rows(found)
        if self._left_out is not None:
            self._left_out.update(constants)
        with self._lock:
            self._cache[key] = arrays
            while len(self._cache) > _CACHED:
                self._cache.popitem(last=False)
        return arrays


@contextlib.contextmanager
def left_out() -> Iterator[set[str]]:
    """The names of texts and values of episodes that the readers opened meanwhile return, and the engine does not get."""
    names: set[str] = set()
    token = _LEFT_OUT.set(names)
    try:
        yield names
    finally:
        _LEFT_OUT.reset(token)


def engine_of(dataset: Any) -> Any:
    """The engine's dataset for a dataset of any class.

    Readers of user-defined formats need `lengths`, and `_load_slice(episode, start, end)` or `load_episode(episode)`.
    """
    own = getattr(dataset, "engine", None)
    if isinstance(own, _engine.Dataset):
        return own
    if not hasattr(dataset, "lengths") or not (hasattr(dataset, "_load_slice") or hasattr(dataset, "load_episode")):
        raise TypeError(f"expected a dataset, with `lengths` and `load_episode` or `_load_slice`, got {type(dataset).__name__}")
    return _engine.Dataset.foreign(_Rows(dataset))


#: The methods that return samples.
_SAMPLES = ("__getitem__", "__getitems__")
#: The methods that read rows.
ROWS = ("load_chunk", "load_episode", "_load_slice")


def check_overrides(caller: str, dataset: Any, instead: str, methods: Sequence[str] = (*_SAMPLES, *ROWS)) -> None:
    """Checks that the engine reads what a dataset's class returns.

    Args:
        caller: The function or class that reads the dataset in the engine.
        dataset: The dataset; datasets that it joins are checked, too.
        instead: What the user can do instead.
        methods: The methods that decide what is read.

    Raises:
        TypeError: If a user's subclass of a dataset that the engine reads overrides how it is read.
    """
    if isinstance(dataset, (StoredDataset, ReplayBuffer, ConcatDataset, MergeDataset)):
        for method in methods:
            if hasattr(dataset, method) and is_overridden(dataset, method):
                raise TypeError(
                    f"{caller}: the engine reads stored rows and would not call {type(dataset).__name__}.{method}; {instead}"
                )
    if isinstance(dataset, (ConcatDataset, MergeDataset)):
        for part in dataset.datasets:
            check_overrides(caller, part, instead, methods)
