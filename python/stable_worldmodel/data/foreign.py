"""Converts readers implemented in Python to datasets of the engine, for loading and conversion."""

from __future__ import annotations

import contextlib
import copy
import os
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from typing import Any

from stable_worldmodel import _engine
from stable_worldmodel._forks import fork_lock
from stable_worldmodel._overrides import is_overridden

from . import _tensors
from ._tensors import Array
from .buffer import ReplayBuffer
from .dataset import ConcatDataset, MergeDataset, StoredDataset
from .format import episode_lengths

__all__ = ["check_distinct", "check_overrides", "engine_of", "left_out", "note_location"]

#: The number of cached slices: a conversion reads the columns of an episode one after another.
_CACHED = 4

#: Readers of the user are called one at a time, because threads of the engine call them, and several may share a buffer.
_READING = fork_lock()

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
        self._lengths = episode_lengths(self._reader, is_kept=True)
        #: The columns of the first episode that has rows.
        self._names: list[str] = []
        self._cache: OrderedDict[tuple[int, int, int], dict[str, Array]] = OrderedDict()
        self._lock = fork_lock()
        self._left_out = _LEFT_OUT.get()
        if self._left_out is not None and getattr(reader, "episode_column_names", None):
            self._left_out.add(_tensors.EPISODE)

    def lengths(self) -> list[int]:
        return self._lengths

    def schema(self) -> list[tuple[str, str, list[int]]]:
        episode = next((i for i, length in enumerate(self._lengths) if length > 0), None)
        if episode is None:
            return []
        first = self._slice(episode, 0, self._lengths[episode])
        if not first:
            raise ValueError(f"episode {episode}: it has no columns; give every episode at least one numeric column")
        self._names = list(first)
        return [(name, array.dtype.name, list(array.shape[1:])) for name, array in first.items()]

    def rows(self, column: str, episode: int, start: int, length: int) -> Array:
        arrays = self._slice(episode, start, start + length)
        extra = [name for name in arrays if name not in self._names]
        # What reads other columns loses nothing; a conversion would lose those that the first episode lacks.
        if column not in arrays or (extra and self._left_out is not None):
            missing = [name for name in self._names if name not in arrays]
            raise ValueError(
                f"episode {episode}: an episode must have the columns of the first one: missing {missing}, unexpected {extra}"
            )
        return arrays[column]

    def _check_rows(self, episode: int, content: Mapping[str, Any], names: Iterable[str]) -> None:
        """Checks that columns of a whole episode have as many rows as `lengths` says; `action` may have one fewer.

        More rows are only refused in a conversion, which would lose them.
        """
        length = self._lengths[episode]
        for name in names:
            rows = len(content[name]) if hasattr(content[name], "__len__") else length
            loses = rows > length and self._left_out is not None
            if loses or rows < length - (name == "action"):
                raise ValueError(
                    f"episode {episode}: load_episode returns {rows} rows of {name!r}, but lengths[{episode}] is {length}; "
                    f"correct the reader {type(self._reader).__name__}"
                )

    def _slice(self, episode: int, start: int, end: int) -> dict[str, Array]:
        key = (episode, start, end)
        with self._lock:
            if key in self._cache:
                return self._cache[key]
        content: dict[str, Any] = {}
        with _READING:
            if hasattr(self._reader, "_load_slice"):
                found = self._reader._load_slice(episode, start, end)
            else:
                content = dict(self._reader.load_episode(episode).items())
                whole = (str, bytes, Mapping)
                found = {name: value if isinstance(value, whole) else value[start:end] for name, value in content.items()}
            # A slice has one action for each row, also for the last row of an episode.
            arrays, constants = _tensors.rows(found)
            # The reader may fill its buffer with the next episode.
            arrays = {name: array.copy() for name, array in arrays.items()}
        self._check_rows(episode, content, [name for name in arrays if name in content])
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


#: The attribute of a user's reader with the location from which it was opened.
_LOCATION = "_swm_location"


def note_location(reader: Any, path: str) -> None:
    """Notes the location from which a user's reader was opened, for :func:`check_distinct`."""
    # Past a `__setattr__` of the user, which may refuse it.
    with contextlib.suppress(AttributeError, TypeError):
        object.__setattr__(reader, _LOCATION, path if "://" in path else os.path.abspath(path))


def _locations(dataset: Any) -> Iterator[str]:
    """The locations that a dataset reads, as far as they are known: an open reader of the user may have one as `path`."""
    if isinstance(dataset, (ConcatDataset, MergeDataset)):
        for part in dataset.datasets:
            yield from _locations(part)
    for name in (_LOCATION, "path"):
        given: Any = None
        # A property of the user may fail.
        with contextlib.suppress(Exception):
            given = os.fspath(getattr(dataset, name))
        if isinstance(given, str):
            yield given


def check_distinct(dataset: Any, target: str) -> None:
    """Checks that a dataset is not written over a dataset that it is read from, nor into a folder that holds it.

    The engine checks this of the datasets that it reads; here it is checked of user-defined formats, too.

    Raises:
        ValueError: If it is.
    """

    def folder(location: str) -> str:
        return (location if "://" in location else os.path.realpath(location)).rstrip("/") + "/"

    for source in _locations(dataset):
        if folder(source).startswith(folder(target)):
            raise ValueError(f"target {target}: is, or holds, the dataset that is read ({source}); give another target")


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
