"""Converts readers implemented in Python to datasets of the engine, for loading and conversion."""

from __future__ import annotations

import copy
import threading
from collections import OrderedDict
from typing import Any

from stable_worldmodel import _engine

from . import _tensors
from ._tensors import Array

__all__ = ["engine_of"]

#: The number of cached slices: a conversion reads the columns of an episode one after another.
_CACHED = 4


class _Rows:
    """Adapts a reader to the methods that the engine calls: `schema`, `lengths` and `rows`."""

    def __init__(self, reader: Any) -> None:
        # Read stored rows, without frameskip, clips and transform.
        self._reader = copy.copy(reader)
        for name, value in (("frameskip", 1), ("num_steps", 1), ("span", 1), ("transform", None)):
            if hasattr(self._reader, name):
                setattr(self._reader, name, value)
        self._cache: OrderedDict[tuple[int, int, int], dict[str, Array]] = OrderedDict()
        self._lock = threading.Lock()

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
            found = {name: value if isinstance(value, str) else value[start:end] for name, value in content.items()}
        # A slice has one action for each row, also for the last row of an episode.
        arrays, _ = _tensors.rows(found)
        with self._lock:
            self._cache[key] = arrays
            while len(self._cache) > _CACHED:
                self._cache.popitem(last=False)
        return arrays


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
