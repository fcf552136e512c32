"""Batches for training, prefetched by threads of the engine instead of worker processes."""

from __future__ import annotations

import atexit
import json
import math
import operator
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from stable_worldmodel import _engine, _options

from . import _tensors
from ._tensors import NUMBERING, Array
from .dataset import (
    ConcatDataset,
    MergeDataset,
    StoredDataset,
    Transform,
    at_this_moment,
    joins_episodes,
    transformed,
    transforms_of,
)
from .foreign import check_overrides, engine_of
from .utils import load_dataset

__all__ = ["Goals", "Loader"]

#: The column with the index of a clip's episode.
_EPISODE = NUMBERING[0]

atexit.register(_engine.end_loaders)


@dataclass(frozen=True)
class Goals:
    """The distribution of a goal row for every clip.

    A batch has the goal's columns as `NAME_COLUMN` `(B, 1, ...)`. `NAME_offset` `(B,)` is the number of rows from the anchor
    (a step of the clip) to the goal: 0 for the anchor itself, and -1 for an earlier row or one of another episode.

    Attributes:
        columns: The columns to load from the goal row.
        random: The probability of any row of any episode.
        geometric: The probability of a later step, `k` steps ahead with probability `(1 - discount) * discount**(k - 1)`.
        future: The probability of a later step, all later steps equally likely.
        last: The probability of the episode's last row.
        current: The probability of the anchor itself.
        discount: The discount of the geometric distribution.
        anchor: The index of the current step in the clip; the last step for `None`.
        name: The prefix of the column names.
    """

    columns: Sequence[str] = ("pixels",)
    random: float = 0.3
    geometric: float = 0.5
    future: float = 0.0
    last: float = 0.0
    current: float = 0.2
    discount: float = 0.99
    anchor: int | None = None
    name: str = "goal"

    def spec(self) -> dict[str, Any]:
        """The goal specification for the engine."""
        chances = ("random", "geometric", "future", "last", "current", "discount")
        mixture = {chance: _options.finite(f"Goals.{chance}", getattr(self, chance)) for chance in chances}
        anchor = None if self.anchor is None else _options.count("Goals.anchor", self.anchor, 0)
        return {"name": self.name, "columns": [*self.columns], "anchor": anchor, "mixture": mixture}


def bytes_of(given: int | str) -> int:
    """A size in bytes, given as an integer or as text such as `"512MB"` or `"2GiB"`."""
    if not isinstance(given, str):
        return int(given)
    units = {"": 1, "B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}
    units |= {"KIB": 2**10, "MIB": 2**20, "GIB": 2**30, "TIB": 2**40}
    text = given.strip().upper()
    number = text.rstrip("BKMGTI").strip()
    unit = text[len(number) :].strip()
    try:
        return int(float(number) * units[unit])
    except (KeyError, ValueError) as error:
        raise ValueError(f"expected a number of bytes, such as 536870912 or '512MB', got {given!r}") from error


class Loader:
    """Shuffled batches of clips, prefetched and decoded by threads of the engine.

        loader = Loader("pusht.lance", batch_size=64, num_steps=4, frameskip=5, columns=["pixels", "action"])
        for batch in loader:
            batch["pixels"]  # (64, 4, 3, 224, 224), uint8
            batch["action"]  # (64, 4, 10)

    Each iteration is the next epoch, in an order that depends on the seed and the epoch. The tensors share the engine's
    memory, which is reused after the last tensor is released. Images are `(B, T, C, H, W)` in torch's memory format
    `channels_last`.

    Args:
        dataset: A path, a URI, a name, or an open dataset of any format.
        batch_size: The number of clips of a batch.
        num_steps: The number of steps of a clip; `None` uses the value of the open dataset, or 1.
        frameskip: The number of rows from one step to the next; `None` uses the value of the open dataset, or 1.
        columns: The columns to load; `None` loads the columns of the open dataset, or all columns.
        shuffle: Whether clips come in random order, over the whole dataset.
        seed: Determines the order and the goals, together with the epoch.
        drop_last: Whether a last batch with fewer clips is left out.
        episodes: The indices of the episodes to use, or a mask of one boolean for each episode; all episodes for `None`.
        goals: The goals to sample for every clip: one `Goals`, or several with different names.
        transform: Called with the dict of every batch, in which `action` is `(batch, num_steps * frameskip, action_dim)`. It
            gets what the transform of the dataset returns, which is called with every sample before, on the CPU.
        device: The device to which tensors are moved; the CPU for `None`.
        pin_memory: Whether tensors are in page-locked memory, from which a GPU copies without waiting; with `device`, before
            they are moved. Without a GPU it has no effect.
        rank, world_size: The index of this process among those of a distributed training. Every process gets a slice of each
            batch, and all slices together are the batch: `batch_size`, the number of batches and their order do not depend
            on `world_size`. The sizes of slices differ by at most 1; those of a short last batch may be empty.
        threads: The number of prefetch threads, which decode on the engine's threads; 0 loads batches on demand.
        prefetch: The maximum number of prefetched batches.
        prefetch_bytes: The maximum size of prefetched batches.
        cache: The size of the cache of decoded rows for later epochs, such as `"8GB"`; 0 disables it. The default is
            512 MiB for datasets that the engine reads.
        cache_dir: A folder for a cache on disk that several runs share, instead of memory.
        backend: `"torch"` or `"numpy"`; `None` selects torch if it is installed.
        format: The dataset's format; `None` detects it from the path.
    """

    def __init__(
        self,
        dataset: Any,
        batch_size: int = 64,
        *,
        num_steps: int | None = None,
        frameskip: int | None = None,
        columns: Sequence[str] | None = None,
        shuffle: bool = True,
        seed: int = 0,
        drop_last: bool = False,
        episodes: Sequence[int] | Sequence[bool] | Array | None = None,
        goals: Goals | Sequence[Goals] | None = None,
        transform: Transform | None = None,
        device: Any = None,
        pin_memory: bool = False,
        rank: int = 0,
        world_size: int = 1,
        threads: int = 2,
        prefetch: int = 4,
        prefetch_bytes: int | str = "512MiB",
        cache: int | str | None = None,
        cache_dir: str | os.PathLike[str] | None = None,
        backend: str | None = None,
        format: str | None = None,
    ) -> None:
        if isinstance(dataset, (str, os.PathLike)):
            dataset = load_dataset(dataset, format=format)
        elif format is not None:
            raise TypeError("format: it selects how a path is opened, and the given dataset is open already; omit it")
        self.dataset = dataset
        self.backend = _tensors.backend(backend if backend is not None else getattr(dataset, "backend", None))
        if device is not None and self.backend == "numpy":
            raise ValueError("device: numpy arrays stay on the CPU; use backend='torch'")
        self.device = device
        self.pin_memory = bool(pin_memory) and self.backend == "torch" and _tensors.has_gpu()
        self.transform = transform
        #: The dataset, or the content of its replay buffers, that the engine reads.
        self._content = at_this_moment(dataset, None)
        check_overrides("Loader", dataset, "use torch's DataLoader, or the dataset's transform")
        #: Whether the dataset, or one that it joins, has a transform of samples.
        self._has_own = bool(transforms_of(self._content))
        if isinstance(dataset, MergeDataset):
            _warn_of_transforms(dataset)
        self.batch_size = _options.whole("batch_size", batch_size)
        self.seed = _options.whole("seed", seed)
        if cache is None:
            cache = "512MiB" if isinstance(dataset, (StoredDataset, ConcatDataset, MergeDataset)) else 0
        engine = engine_of(self._content)
        stored = {name: tuple(shape) for name, _, shape in engine.schema()}
        if columns is None:
            columns = list(getattr(dataset, "column_names", None) or [n for n in stored if n not in NUMBERING])
        if isinstance(columns, str):
            raise TypeError(f"columns: expected a list of names, such as [{columns!r}]")
        unknown = [name for name in columns if name not in stored]
        if unknown:
            raise KeyError(f"there is no column {unknown[0]!r}; the columns are {', '.join(stored)}")
        joins = self._has_own and joins_episodes(dataset)
        if joins and (_EPISODE not in stored or engine.episode_indices().tolist() != list(range(len(engine.lengths())))):
            raise ValueError(
                "transform: the episodes of the joined datasets are not numbered from 0, so the transform of a clip is "
                "unknown; use torch's DataLoader"
            )
        #: Whether batches of the engine have the episodes of clips only to find their transforms.
        self._adds_episodes = joins and _EPISODE not in columns
        given = [goals] if isinstance(goals, Goals) else list(goals or [])
        num_steps = num_steps if num_steps is not None else getattr(dataset, "num_steps", 1)
        frameskip = frameskip if frameskip is not None else getattr(dataset, "frameskip", 1)
        self.num_steps, self.frameskip = _options.whole("num_steps", num_steps), _options.whole("frameskip", frameskip)
        self._shuffle = bool(shuffle)
        settings = {
            "num_steps": self.num_steps,
            "frameskip": self.frameskip,
            "columns": [*columns, _EPISODE] if self._adds_episodes else [*columns],
            "goals": [goal.spec() for goal in given],
            "batch_size": self.batch_size,
            "shuffle": self._shuffle,
            "seed": self.seed,
            "drop_last": bool(drop_last),
            "rank": _options.whole("rank", rank),
            "ranks": _options.whole("world_size", world_size),
            "threads": _options.whole("threads", threads),
            "prefetch": _options.whole("prefetch", prefetch),
            "prefetch_bytes": bytes_of(prefetch_bytes),
            "episodes": None if episodes is None else _options.indices("episodes", episodes, len(engine.lengths())),
            "cache": bytes_of(cache),
            "cache_dir": None if cache_dir is None else os.fspath(cache_dir),
        }
        if any(isinstance(value, int) and value < 0 for value in settings.values()):
            negative = {name: value for name, value in settings.items() if isinstance(value, int) and value < 0}
            raise ValueError(f"expected no negative numbers, got {negative}")
        self._settings = json.dumps(settings)
        self._loader = _engine.Loader(engine, self._settings)
        #: The shape of a row of every column: the axes after the batch and the steps.
        self._shapes = {name: tuple(shape[1:]) for name, _, shape in self._loader.schema()}
        if self._adds_episodes:
            del self._shapes[_EPISODE]
        # The dataset returns some scalar columns as lists of one element, so the loader returns such lists, too.
        for name, (_, shape) in getattr(dataset, "schema", {}).items():
            for column in (name, *(f"{goal.name}_{name}" for goal in given)):
                if name != "action" and self._shapes.get(column) == () and shape == (1,):
                    self._shapes[column] = shape
        self._action = stored.get("action")
        #: A batch without samples, as the transform of the dataset returns it.
        self._empty: dict[str, Any] | None = None
        #: The epoch and batch at which the next iteration starts.
        self._next = (0, 0)
        #: The epoch and batch that the latest iteration has reached.
        self._at = (0, 0)

    def __getstate__(self) -> dict[str, Any]:
        """The attributes with the position of the iteration; the process that unpickles opens the dataset again."""
        return {**self.__dict__, "_loader": None, "_content": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._content = at_this_moment(self.dataset, None)
        self._loader = _engine.Loader(engine_of(self._content), self._settings)

    def __len__(self) -> int:
        """The number of batches in an epoch, on every rank."""
        return int(self._loader.batches())

    @property
    def num_clips(self) -> int:
        """The number of clips in an epoch, of all ranks together."""
        return int(self._loader.clips())

    @property
    def column_names(self) -> list[str]:
        """The columns of a batch."""
        return list(self._shapes)

    def set_epoch(self, epoch: int) -> None:
        """Starts the next iteration with this epoch; keeps the position in the epoch if the epoch does not change."""
        if epoch != self._next[0]:
            self._next = (int(epoch), 0)

    def state_dict(self) -> dict[str, int]:
        """The position of the iteration, for :meth:`load_state_dict`."""
        epoch, batch = self._at
        settings = {"num_steps": self.num_steps, "frameskip": self.frameskip, "shuffle": int(self._shuffle)}
        position = {"epoch": epoch, "batch": batch}
        return {**position, "seed": self.seed, "batch_size": self.batch_size, "clips": self.num_clips, **settings}

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Continues at a saved position: the next batches equal the batches that followed the position.

        The rank and the number of processes may be others, which divide each batch otherwise.
        """
        own = self.state_dict()
        needed = ("epoch", "batch", "seed", "batch_size", "clips")
        if not isinstance(state, Mapping) or any(name not in state for name in needed):
            raise ValueError(f"state: expected what state_dict returned, with the keys {', '.join(own)}, got {state!r}")
        # States of earlier versions have fewer settings.
        settings = [name for name in own if name not in ("epoch", "batch") and name in state]
        changed = {name: (state[name], own[name]) for name in settings if state[name] != own[name]}
        if changed:
            changes = ", ".join(f"{name} was {was} and is {now}" for name, (was, now) in changed.items())
            raise ValueError(
                f"the state belongs to a loader with other settings ({changes}); create it with the saved settings"
            )
        epoch, batch = operator.index(state["epoch"]), operator.index(state["batch"])
        if epoch < 0 or not 0 <= batch <= len(self):
            raise ValueError(f"the state has epoch {epoch} and batch {batch}; expected a batch from 0 to {len(self)}")
        self._next = self._at = (epoch, batch)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """Yields the batches of an epoch. The next iteration yields the next epoch, also if this iteration ends early."""
        epoch, batch = self._next
        self._next = (epoch + 1, 0)
        self._at = (epoch, batch)
        return self._batches(epoch, batch)

    def _batches(self, epoch: int, batch: int) -> Iterator[dict[str, Any]]:
        shaped = self._read(epoch, batch)
        # Page-locked memory is filled while the batch before is used. A transform runs in the thread of its user.
        plain = self.transform is None and not self._has_own
        for value in _ahead(shaped) if self.pin_memory and self.device is not None and plain else shaped:
            batch += 1
            self._at = (epoch, batch) if batch < len(self) else (epoch + 1, 0)
            yield value

    def _read(self, epoch: int, batch: int) -> Iterator[dict[str, Any]]:
        """The batches of an epoch as the engine reads them, with their shapes and transforms."""
        batches = self._loader.epoch(epoch, batch)
        try:
            while (found := batches.next()) is not None:
                yield self._shaped(found)
        except StopIteration as error:
            # Python would take it for the end of the epoch.
            raise RuntimeError(
                "Loader: the reader of the dataset, or a transform, raised StopIteration, as next(...) without a default does; "
                "give next a default, or raise another exception"
            ) from error

    def _shaped(self, found: dict[str, Array]) -> dict[str, Any]:
        batch: dict[str, Any] = {}
        episodes = found.pop(_EPISODE) if self._adds_episodes else found.get(_EPISODE)
        for name, array in found.items():
            shape = self._shapes[name]
            if shape == (1,) and array.ndim == 2:
                array = array[..., np.newaxis]
            batch[name] = _tensors.wrap(_tensors.channels_first(array, shape), self.backend)
        if self.transform is None and not self._has_own:
            return {name: self._placed(value) for name, value in batch.items()}
        if "action" in batch and self._action is not None:
            size = len(batch["action"])
            batch["action"] = batch["action"].reshape(size, self.num_steps * self.frameskip, *self._action)
        if self._has_own:
            batch = self._transformed(batch, episodes)
        batch = {name: self._placed(value) for name, value in batch.items()}
        if self.transform is not None:
            batch = self.transform(batch)
        if "action" in batch:
            shape = batch["action"].shape
            batch["action"] = batch["action"].reshape(shape[0], self.num_steps, math.prod(shape[1:]) // self.num_steps)
        return batch

    def _placed(self, value: Any) -> Any:
        """A tensor in page-locked memory and on the device, if these are chosen; other values unchanged."""
        if not hasattr(value, "pin_memory"):
            return value
        value = value.pin_memory() if self.pin_memory else value
        return value if self.device is None else value.to(self.device, non_blocking=True)

    def _transformed(self, batch: dict[str, Any], episodes: Array | None) -> dict[str, Any]:
        """The batch of the samples that the transform of the dataset returns."""
        size = len(next(iter(batch.values())))
        if size == 0:
            if self._empty is None:
                raise ValueError(
                    "transform: this process got no samples of the first batch, so the columns that the dataset's transform "
                    "returns are unknown; use drop_last=True, a larger dataset, or a smaller world_size"
                )
            return dict(self._empty)
        views = [{name: column[i] for name, column in batch.items()} for i in range(size)]
        numbers = [0] * size if episodes is None else episodes.reshape(size, -1)[:, 0].tolist()
        samples = [transformed(self._content, dict(view), number) for view, number in zip(views, numbers, strict=True)]
        names = list(samples[0])
        if other := next((list(sample) for sample in samples if sample.keys() != samples[0].keys()), None):
            raise ValueError(f"transform: the samples of a batch need the same columns, got {names} and {other}")
        found = {}
        for name in names:
            values = [sample[name] for sample in samples]
            # A column that the transform keeps is not copied.
            kept = name in batch and all(value is view[name] for value, view in zip(values, views, strict=True))
            found[name] = batch[name] if kept else self._stacked(name, values)
        if self._empty is None:
            self._empty = {name: _without_samples(value) for name, value in found.items()}
        return found

    def _stacked(self, name: str, values: list[Any]) -> Any:
        """The values of a column along a new first axis."""
        try:
            if self.backend == "numpy":
                return np.stack([np.asarray(value) for value in values])
            from torch.utils.data import default_collate

            return default_collate(values)
        except (RuntimeError, TypeError, ValueError) as error:
            raise ValueError(
                f"transform: the samples' values of {name!r} cannot be stacked to a batch ({error}); return arrays of one "
                "shape, or use torch's DataLoader with a collate_fn"
            ) from error

    def __repr__(self) -> str:
        clips = f"{self.num_clips} clips of {self.num_steps} steps, frameskip {self.frameskip}"
        return f"Loader({len(self)} batches of {self.batch_size}: {clips})"


def _without_samples(value: Any) -> Any:
    """The values of a batch without samples, which share no memory with it."""
    if isinstance(value, np.ndarray):
        return value[:0].copy()
    return value[:0].clone() if hasattr(value, "clone") else type(value)()


def _ahead(batches: Iterator[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """The batches, of which a thread makes the next one while one is used."""
    with ThreadPoolExecutor(1, "loader") as thread:
        following = thread.submit(next, batches, None)
        while (batch := following.result()) is not None:
            following = thread.submit(next, batches, None)
            yield batch


def _warn_of_transforms(dataset: MergeDataset) -> None:
    """Warns of transforms of parts that get fewer columns than in `dataset[i]`: those of the merged dataset."""
    for index, (part, keys) in enumerate(zip(dataset.datasets, dataset.keys_map, strict=True)):
        left_out = [name for name in getattr(part, "column_names", None) or [] if name not in keys]
        if left_out and transforms_of(part):
            warnings.warn(
                f"Loader: the transform of dataset {index} gets the columns {', '.join(keys) or 'none'}, without "
                f"{', '.join(left_out)}, which dataset[i] gives it; take them from that dataset, or use torch's DataLoader",
                stacklevel=3,
            )
