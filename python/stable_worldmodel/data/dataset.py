"""Datasets that split episodes into clips, and datasets derived from other datasets."""

from __future__ import annotations

import copy
import json
import math
import os
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from stable_worldmodel import _engine, _options

from . import _collate, _tensors
from ._tensors import NUMBERING, Array

Transform = Callable[[dict[str, Any]], dict[str, Any]]
#: The index of a row, or the indices of several rows.
Rows = int | Sequence[int] | Array

__all__ = ["ConcatDataset", "Dataset", "GoalDataset", "MergeDataset", "StoredDataset"]


class Dataset:
    """A dataset whose samples are the clips of `num_steps` steps in its episodes.

    A clip covers `num_steps * frameskip` rows. Step `k` of a clip has the columns of row `k * frameskip` and the actions of
    the `frameskip` rows from that row on: `action` has the shape `(num_steps, frameskip * dim)`, every other column
    `(num_steps, ...)`, images `(T, C, H, W)` with `T = num_steps`.

    Readers of user-defined formats derive from this class and implement `column_names` and `_load_slice`.

    Args:
        lengths: The number of rows of every episode.
        offsets: The index of every episode's first row in the whole dataset.
        frameskip: The number of rows from one step to the next.
        num_steps: The number of steps of a clip.
        transform: A function from the dict of a sample to the sample that the dataset returns.
    """

    #: The number of rows of every episode.
    lengths: Array
    #: The index of every episode's first row in the whole dataset.
    offsets: Array

    def __init__(
        self,
        lengths: Sequence[int] | Array,
        offsets: Sequence[int] | Array,
        frameskip: int = 1,
        num_steps: int = 1,
        transform: Transform | None = None,
    ) -> None:
        self.frameskip = _options.count("frameskip", frameskip)
        self.num_steps = _options.count("num_steps", num_steps)
        self.lengths, self.offsets = (np.array(rows, dtype=np.int64) for rows in (lengths, offsets))
        self._protect()
        self.span = self.num_steps * self.frameskip
        self.transform = transform
        clips = np.maximum(self.lengths - self.span + 1, 0)
        #: The number of clips before every episode, and at the end the number of all clips.
        self._clips_before = np.concatenate([[0], np.cumsum(clips)]).astype(np.int64)

    def _protect(self) -> None:
        """Makes lengths and offsets read-only: what is written there would not change the episodes."""
        for rows in (getattr(self, name, None) for name in ("lengths", "offsets")):
            if isinstance(rows, np.ndarray):
                rows.setflags(write=False)

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        # Pickles do not keep the flag.
        self._protect()

    @property
    def column_names(self) -> list[str]:
        """The columns of a sample."""
        raise NotImplementedError(f"{type(self).__name__}.column_names")

    @property
    def _row_shapes(self) -> dict[str, tuple[int, ...]]:
        """The shapes of a row of the columns, as far as they are known."""
        return {}

    def _load_slice(self, ep_idx: int, start: int, end: int) -> dict[str, Any]:
        """The rows `start .. end` of an episode: all rows of `action`, every `frameskip`-th row of other columns.

        The result is the output of `transform`, if there is one.
        """
        raise NotImplementedError(f"{type(self).__name__}._load_slice")

    @property
    def num_episodes(self) -> int:
        """The number of episodes."""
        return len(self.lengths)

    @property
    def clip_indices(self) -> list[tuple[int, int]]:
        """The episode and the first row of every clip; the list has one entry for each sample."""
        episodes, starts = self._clips(np.arange(len(self)))
        return list(zip(episodes.tolist(), starts.tolist(), strict=True))

    def _clips(self, indices: Array) -> tuple[Array, Array]:
        """The episodes and the first rows of the clips with these indices."""
        total = int(self._clips_before[-1])
        wrong = (indices < -total) | (indices >= total)
        if wrong.any():
            raise IndexError(f"clip {int(indices[wrong][0])} is outside the dataset, which has {total} clips")
        indices = np.where(indices < 0, indices + total, indices)
        episodes = np.searchsorted(self._clips_before, indices, side="right") - 1
        return episodes, indices - self._clips_before[episodes]

    def __len__(self) -> int:
        return int(self._clips_before[-1])

    def __getitem__(self, idx: int) -> dict[str, Any]:
        episodes, starts = self._clips(_tensors.whole("index", [idx]))
        start = int(starts[0])
        return self._grouped(self._load_slice(int(episodes[0]), start, start + self.span), self.num_steps)

    def _grouped(self, sample: dict[str, Any], steps: int) -> dict[str, Any]:
        """The sample, with the actions of each step joined into one row of `action`."""
        if "action" in sample:
            action = sample["action"]
            # The width is stated, because there may be no steps.
            sample["action"] = action.reshape(steps, self.frameskip * math.prod(action.shape[1:]))
        return sample

    def load_chunk(
        self, episodes_idx: Sequence[int] | Array, start: Sequence[int] | Array, end: Sequence[int] | Array
    ) -> list[dict[str, Any]]:
        """The rows `start[i] .. end[i]` of each episode `episodes_idx[i]`, as a list of dicts in the form of clips.

        Raises:
            IndexError: If an episode does not exist, or does not have these rows.
            ValueError: If the sequences have other lengths, or there are actions and the rows are no multiple of `frameskip`.
        """
        episodes, starts, ends = self._chunks(episodes_idx, start, end)
        runs = zip(episodes.tolist(), starts.tolist(), ends.tolist(), strict=True)
        return [self._grouped(self._load_slice(e, s, t), (t - s) // self.frameskip) for e, s, t in runs]

    def _chunks(self, episodes_idx: Any, start: Any, end: Any) -> tuple[Array, Array, Array]:
        """The episodes, first rows and ends of :meth:`load_chunk`, checked; negative episodes count from the last one."""
        episodes, starts, ends = _runs(episodes_idx, start, end)
        rows = ends - starts
        if (rows % self.frameskip).any() and "action" in self.column_names:
            raise ValueError(f"load_chunk: {rows.tolist()} rows are no multiples of frameskip {self.frameskip}")
        return self._counted(episodes, starts, ends), starts, ends

    def _counted(self, episodes: Array, starts: Array, ends: Array) -> Array:
        """The episodes of runs of rows, counted from the first one, if they exist and have these rows."""
        total = self.num_episodes
        for episode, start, end in zip(episodes, starts, ends, strict=True):
            if not -total <= episode < total:
                raise IndexError(f"episode {episode} is outside the dataset, which has {total} episodes")
            if not 0 <= start <= end <= self.lengths[episode]:
                raise IndexError(f"rows {start} .. {end} are outside episode {episode}, which has {self.lengths[episode]} rows")
        return np.where(episodes < 0, episodes + total, episodes)

    def load_episode(self, episode_idx: int) -> dict[str, Any]:
        """A whole episode: all rows of `action`, every `frameskip`-th row of other columns."""
        none = np.zeros(1, np.int64)
        episode = int(self._counted(_tensors.whole("episode_idx", [episode_idx]), none, none)[0])
        return self._load_slice(episode, 0, int(self.lengths[episode]))

    def get_col_data(self, col: str) -> Array:
        """All rows of a column, `(rows, ...)`; images `(rows, H, W, C)`."""
        raise NotImplementedError(f"{type(self).__name__}.get_col_data")

    def get_row_data(self, row_idx: Rows) -> dict[str, Array]:
        """The rows with these indices in the whole dataset: `(...)` for one index, `(rows, ...)` for several."""
        raise NotImplementedError(f"{type(self).__name__}.get_row_data")

    def _rows(self, row_idx: Rows) -> tuple[Array, Array]:
        """The episodes of rows of the whole dataset, and the rows in them; negative rows count from the last one."""
        rows = np.atleast_1d(_tensors.whole("row_idx", row_idx))
        total = int(self.lengths.sum())
        if ((rows < -total) | (rows >= total)).any():
            raise IndexError(f"some of the rows {rows.tolist()} are outside the dataset, which has {total} rows")
        rows = np.where(rows < 0, rows + total, rows)
        # An episode without rows has the offset of the next episode; `side="right"` selects the later of the two.
        episodes = np.searchsorted(self.offsets, rows, side="right") - 1
        return episodes, rows - self.offsets[episodes]

    @property
    def episode_column_names(self) -> list[str]:
        """The values that every episode has (`EPISODE_DATA_KEY` of a written episode)."""
        return list(self.get_episode_data([0])) if self.num_episodes else []

    def get_episode_data(self, episodes_idx: Sequence[int] | Array | None = None) -> dict[str, Array]:
        """The values of episodes, `(episodes, ..)`; of all episodes for `None`."""
        given = np.arange(self.num_episodes) if episodes_idx is None else _tensors.whole("episodes_idx", episodes_idx)
        return _tensors.episode_table([self._episode_values(int(episode)) for episode in given.reshape(-1)])

    def _episode_values(self, episode: int) -> dict[str, Any]:
        """The values of one episode."""
        return {}

    def get_dim(self, col: str) -> int:
        """The number of elements in a row of a column."""
        data = self.get_col_data(col)
        return int(np.prod(data.shape[1:]))

    def merge_col(self, source: list[str] | str, target: str, dim: int = -1) -> None:
        """Adds the column `target`, which concatenates columns along `dim`.

        `source` is a list of column names, or a regular expression that the names match.
        """
        raise NotImplementedError(f"{type(self).__name__}.merge_col")


class _Merged:
    """Columns in memory, with the methods that the engine calls: `schema`, `lengths` and `rows`."""

    def __init__(self, columns: dict[str, Array], lengths: Array, offsets: Array) -> None:
        self._columns, self._lengths, self._offsets = columns, lengths, offsets

    def lengths(self) -> list[int]:
        return [int(length) for length in self._lengths]

    def schema(self) -> list[tuple[str, str, list[int]]]:
        return [(name, array.dtype.name, list(array.shape[1:])) for name, array in self._columns.items()]

    def rows(self, column: str, episode: int, start: int, length: int) -> Array:
        first = int(self._offsets[episode]) + start
        return np.ascontiguousarray(self._columns[column][first : first + length])


class StoredDataset(Dataset):
    """A dataset in one of the engine's formats.

    A batch is read in one call, which decodes each row once, on all cores, without the GIL. The dataset can be pickled
    (the process that unpickles it opens the files again) and used after a fork; an error says if the dataset was replaced
    in between.

    Args:
        path: A path, a URI (`s3://`, `gs://`, `az://`, `http(s)://`), or a name under `$STABLEWM_HOME/datasets`.
        frameskip: The number of rows from one step to the next.
        num_steps: The number of steps of a clip.
        transform: A function from the dict of a sample to the sample that the dataset returns.
        keys_to_load: The columns of a sample; all columns for `None`.
        keys_to_cache: Columns whose decoded rows stay in memory.
        keys_to_merge: The columns to add: a dict from target to source, as in :meth:`merge_col`.
        format: The format; `None` detects it from the path.
        backend: `"torch"` or `"numpy"`; `None` selects torch if it is installed.
    """

    #: The format of this class's datasets; any for `None`.
    format: str | None = None
    #: Formats with scalar columns of shape `(num_steps, 1)`, because other packages read them from Lance as lists of one
    #: element.
    _LISTS = ("lance", "lance-video")

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        frameskip: int = 1,
        num_steps: int = 1,
        transform: Transform | None = None,
        keys_to_load: Sequence[str] | None = None,
        keys_to_cache: Sequence[str] | None = None,
        keys_to_merge: Mapping[str, list[str] | str] | None = None,
        format: str | None = None,
        backend: str | None = None,
    ) -> None:
        from .utils import resolve

        self.path = resolve(path)
        self.format = format or self.format or _engine.detect(self.path)
        self.backend = _tensors.backend(backend)
        self._handle: Any = _engine.Dataset(self.path, self.format, None)
        #: What a process that unpickles the dataset compares: it must not read another one in the layout of this.
        self._mark: str | None = self._handle.mark()
        lengths = self._handle.lengths()
        super().__init__(lengths, np.cumsum(lengths) - lengths, frameskip, num_steps, transform)
        scalar = (1,) if self.format in self._LISTS else ()
        #: The type and the shape of a row of every column.
        self.schema: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {
            name: (np.dtype(dtype), tuple(shape) or (() if name in NUMBERING else scalar))
            for name, dtype, shape in self._handle.schema()
        }
        #: The columns that `merge_col` added.
        self._merged: dict[str, Array] = {}
        #: The dataset with the columns that `merge_col` added, as an object of the engine.
        self._view: Any = None
        for given, names in (("keys_to_load", keys_to_load), ("keys_to_cache", keys_to_cache)):
            if isinstance(names, str):
                raise TypeError(f"{given}: {names!r}; expected a list of columns, such as [{names!r}]")
        self._keys = [name for name in self.schema if name not in NUMBERING] if keys_to_load is None else [*keys_to_load]
        self._cached = [*(keys_to_cache or [])]
        for target, source in (keys_to_merge or {}).items():
            self.merge_col(source, target)
        for name in (*self._keys, *self._cached):
            self._check(name)
        if self._cached:
            self._handle = self._open()

    def _open(self) -> Any:
        handle = _engine.Dataset(self.path, self.format, self._mark)
        return handle.cached(self._cached, 1 << 62) if self._cached else handle

    def check_unchanged(self) -> None:
        """Checks that the path still has this dataset.

        Raises:
            RuntimeError: If it was replaced.
        """
        _engine.Dataset(self.path, self.format, self._mark)

    @property
    def _stored(self) -> Any:
        """The stored columns, as an object of the engine."""
        if self._handle is None:
            self._handle = self._open()
        return self._handle

    @property
    def engine(self) -> Any:
        """This dataset as an object of the engine, with the columns that `merge_col` added."""
        if not self._merged:
            return self._stored
        if self._view is None:
            base = self._stored.select([name for name in self.schema if name not in (*NUMBERING, *self._merged)])
            added = _engine.Dataset.foreign(_Merged(dict(self._merged), self.lengths, self.offsets))
            self._view = _engine.Dataset.merge(base, added, list(self._merged))
        return self._view

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_handle": None, "_view": None}

    def __repr__(self) -> str:
        rows = int(self.lengths.sum())
        clips = f"clips of {self.num_steps} steps, frameskip {self.frameskip}"
        return f"{type(self).__name__}({self.path!r}, {self.num_episodes} episodes, {rows} rows, {len(self)} {clips})"

    def _check(self, name: str) -> None:
        if name not in self.schema and name not in self._merged:
            known = ", ".join([*self.schema, *self._merged])
            raise KeyError(f"there is no column {name!r} in {self.path}; the columns are {known}")

    @property
    def column_names(self) -> list[str]:
        return list(self._keys)

    @property
    def manifest(self) -> dict[str, Any] | None:
        """The manifest (provenance) of the dataset, if it has one."""
        text = self._stored.manifest()
        return None if text is None else dict(json.loads(text))

    def constants(self, episode_idx: int) -> dict[str, bytes]:
        """The non-numeric constants of an episode, such as the XML of its scene."""
        return dict(self._stored.constants(int(_tensors.whole("episode_idx", episode_idx))))

    def _episode_values(self, episode: int) -> dict[str, Any]:
        wanted = episode + self.num_episodes if episode < 0 else episode
        if not 0 <= wanted < self.num_episodes:
            raise IndexError(f"episode {episode} is outside the dataset, which has {self.num_episodes} episodes")
        return _tensors.episode_values(self._stored.constants(wanted).get(_tensors.EPISODE))

    @property
    def _row_shapes(self) -> dict[str, tuple[int, ...]]:
        merged, schema = self._merged, self.schema
        return {name: merged[name].shape[1:] if name in merged else schema[name][1] for name in self._keys}

    def _row_shape(self, name: str) -> tuple[int, ...]:
        return self._merged[name].shape[1:] if name in self._merged else self.schema[name][1]

    def _read(self, names: Sequence[str], episodes: Array, starts: Array, lengths: Array, skip: int) -> dict[str, Array]:
        """The concatenated rows of runs, `(rows, ...)`: every row of `action`, every `skip`-th row of other columns."""
        stored = [name for name in names if name not in self._merged]
        found = self._stored.read(stored, *(np.ascontiguousarray(part, np.int64) for part in (episodes, starts, lengths)), skip)
        found = {name: array.reshape(len(array), *self.schema[name][1]) for name, array in found.items()}
        if self._merged:
            firsts = self.offsets[episodes] + starts
            for name in names:
                if name in self._merged:
                    step = 1 if name == "action" else skip
                    at = [np.arange(first, first + length, step) for first, length in zip(firsts, lengths, strict=True)]
                    found[name] = self._merged[name][np.concatenate(at)] if at else self._merged[name][:0]
        return {name: found[name] for name in names}

    def _slices(self, episodes: Array, starts: Array, ends: Array) -> list[dict[str, Any]]:
        """One dict for each run of rows, read in one call of the engine."""
        episodes, starts, ends = (np.asarray(part, dtype=np.int64) for part in (episodes, starts, ends))
        episodes = self._counted(episodes, starts, ends)
        found = self._read(self._keys, episodes, starts, ends - starts, self.frameskip)
        counts = {False: -(-(ends - starts) // self.frameskip), True: ends - starts}
        cuts = {action: np.cumsum(count)[:-1] for action, count in counts.items()}
        parts: dict[str, list[Any]] = {}
        for name, array in found.items():
            array = _tensors.channels_first(array, self._row_shape(name))
            pieces = np.split(array, cuts[name == "action"])
            parts[name] = [_tensors.wrap(piece, self.backend) for piece in pieces]
        samples = [{name: pieces[i] for name, pieces in parts.items()} for i in range(len(episodes))]
        return [self.transform(sample) for sample in samples] if self.transform else samples

    def _load_slice(self, ep_idx: int, start: int, end: int) -> dict[str, Any]:
        return self._slices(np.asarray([ep_idx]), np.asarray([start]), np.asarray([end]))[0]

    def load_chunk(
        self, episodes_idx: Sequence[int] | Array, start: Sequence[int] | Array, end: Sequence[int] | Array
    ) -> list[dict[str, Any]]:
        episodes, starts, ends = self._chunks(episodes_idx, start, end)
        steps = (ends - starts) // self.frameskip
        samples = self._slices(episodes, starts, ends)
        return [self._grouped(sample, int(count)) for sample, count in zip(samples, steps, strict=True)]

    def __getitems__(self, indices: Sequence[int]) -> list[dict[str, Any]]:
        """The samples of a batch, read in one call."""
        if len(indices) == 0:
            return []
        episodes, starts = self._clips(_tensors.whole("indices", indices))
        size = len(episodes)
        found = self._read(self._keys, episodes, starts, np.full(size, self.span), self.frameskip)
        columns: dict[str, Any] = {}
        for name, array in found.items():
            array = array.reshape(size, -1, *self._row_shape(name))
            columns[name] = _tensors.wrap(_tensors.channels_first(array, self._row_shape(name)), self.backend)
        if self.transform is not None:
            samples = [self.transform({name: column[i] for name, column in columns.items()}) for i in range(size)]
            return [self._grouped(sample, self.num_steps) for sample in samples]
        if "action" in columns:
            columns["action"] = columns["action"].reshape(size, self.num_steps, -1)
        _collate.install()
        return _collate.Batch(columns, size).samples()

    def get_col_data(self, col: str) -> Array:
        self._check(col)
        if col in self._merged:
            return self._merged[col].copy()
        all_episodes = np.arange(self.num_episodes)
        return self._read([col], all_episodes, np.zeros_like(all_episodes), self.lengths, 1)[col]

    def get_row_data(self, row_idx: Rows) -> dict[str, Array]:
        episodes, starts = self._rows(row_idx)
        found = self._read(self._keys, episodes, starts, np.ones_like(starts), 1)
        return {name: array[0] for name, array in found.items()} if np.ndim(row_idx) == 0 else found

    def get_dim(self, col: str) -> int:
        self._check(col)
        return int(np.prod(self._row_shape(col)))

    def merge_col(self, source: list[str] | str, target: str, dim: int = -1) -> None:
        if isinstance(source, str):
            pattern = re.compile(source)
            source = [name for name in self.schema if name not in NUMBERING and pattern.match(name)]
        if not source:
            raise KeyError(f"no column of {self.path} matches the source of {target!r}")
        merged = np.concatenate([self.get_col_data(name) for name in source], axis=dim)
        rows = int(self.lengths.sum())
        if len(merged) != rows:
            raise ValueError(
                f"merge_col: the columns {', '.join(source)} joined along axis {dim} have {len(merged)} rows, expected {rows}; "
                "choose another dim, or leave out columns of scalars"
            )
        self._merged[target], self._view = merged, None
        if target not in self._keys:
            self._keys.append(target)


def _runs(episodes_idx: Any, start: Any, end: Any) -> tuple[Array, Array, Array]:
    """The arguments of `load_chunk` as arrays of one length."""
    episodes, starts, ends = (_tensors.whole("load_chunk", part) for part in (episodes_idx, start, end))
    if episodes.ndim != 1 or not episodes.shape == starts.shape == ends.shape:
        raise ValueError(
            "load_chunk: expected sequences of one length as episodes_idx, start and end, "
            f"got the shapes {episodes.shape}, {starts.shape} and {ends.shape}"
        )
    return episodes, starts, ends


def _check_same_clips(name: str, datasets: Sequence[Any]) -> None:
    """Checks that the clips of datasets have the same steps, as far as the datasets state them.

    Raises:
        ValueError: If not.
    """
    for key in ("num_steps", "frameskip"):
        stated = {value for dataset in datasets if isinstance(value := getattr(dataset, key, None), (int, np.integer))}
        if len(stated) > 1:
            raise ValueError(f"{name}: the datasets must have the same num_steps and frameskip, got {key} {sorted(stated)}")


class MergeDataset:
    """The columns of several datasets with the same episodes.

    Args:
        datasets: The datasets.
        keys_from_dataset: The columns to take from each dataset. `None` takes from each dataset the columns that no earlier
            dataset has. A column can be taken from one dataset only.
    """

    def __init__(self, datasets: Sequence[Any], keys_from_dataset: Sequence[Sequence[str]] | None = None) -> None:
        if not datasets:
            raise ValueError("MergeDataset: expected at least one dataset")
        self.datasets = list(datasets)
        lengths = [np.asarray(dataset.lengths).tolist() for dataset in self.datasets]
        if any(other != lengths[0] for other in lengths):
            raise ValueError("MergeDataset: the datasets must have the same episodes, but their lengths differ")
        _check_same_clips("MergeDataset", self.datasets)
        if any(len(dataset) != len(self.datasets[0]) for dataset in self.datasets):
            raise ValueError("MergeDataset: the datasets must have the same num_steps and frameskip")
        self._are_chosen = keys_from_dataset is not None
        if keys_from_dataset is None:
            seen: set[str] = set()
            self.keys_map: list[list[str]] = []
            for dataset in self.datasets:
                self.keys_map.append([name for name in dataset.column_names if name not in seen])
                seen.update(self.keys_map[-1])
        else:
            self.keys_map = [list(keys) for keys in keys_from_dataset]
            self._check_keys()

    def _check_keys(self) -> None:
        """Checks that each column is taken from one dataset, which has it.

        Raises:
            KeyError: If a dataset does not have the column.
            ValueError: If there are more or fewer lists than datasets, or a column is taken twice.
        """
        if len(self.keys_map) != len(self.datasets):
            counts = f"{len(self.datasets)} datasets, got {len(self.keys_map)}"
            raise ValueError(f"keys_from_dataset: expected a list of columns for each of {counts}")
        names = self.column_names
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"keys_from_dataset: {', '.join(map(repr, twice))} would be taken twice; take it from one dataset")
        for index, (dataset, keys) in enumerate(zip(self.datasets, self.keys_map, strict=True)):
            known = list(dataset.column_names)
            # A transform can add columns, and an empty replay buffer has none yet.
            unknown = [name for name in keys if name not in known and known and not transforms_of(dataset)]
            if unknown:
                raise KeyError(
                    f"keys_from_dataset: dataset {index} has no column {unknown[0]!r}; its columns are {', '.join(known)}"
                )

    @property
    def column_names(self) -> list[str]:
        """The columns of a sample."""
        return [name for keys in self.keys_map for name in keys]

    @property
    def _row_shapes(self) -> dict[str, tuple[int, ...]]:
        pairs = zip(map(_row_shapes, self.datasets), self.keys_map, strict=True)
        return {name: shapes[name] for shapes, keys in pairs for name in keys if name in shapes}

    @property
    def lengths(self) -> Array:
        """The number of rows of every episode."""
        return np.asarray(self.datasets[0].lengths)

    @property
    def engine(self) -> Any:
        """This dataset as an object of the engine."""
        from .foreign import engine_of

        merged = engine_of(self.datasets[0])
        others = {name for keys in self.keys_map[1:] for name in keys} - set(self.keys_map[0])
        known = [name for name, _, _ in merged.schema() if name not in NUMBERING]
        kept = [name for name in known if name in self.keys_map[0] or not (self._are_chosen or name in others)]
        if kept != known:
            merged = merged.select(kept)
        for dataset, keys in zip(self.datasets[1:], self.keys_map[1:], strict=True):
            merged = _engine.Dataset.merge(merged, engine_of(dataset), keys)
        return merged

    def __getattr__(self, name: str) -> Any:
        if name in ("num_steps", "frameskip", "span", "offsets", "num_episodes", "clip_indices"):
            return getattr(self.datasets[0], name)
        raise AttributeError(f"'MergeDataset' has no attribute {name!r}")

    def __len__(self) -> int:
        return len(self.datasets[0])

    def _picked(self, items: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
        pairs = zip(items, self.keys_map, strict=True)
        return {name: item[name] for item, keys in pairs for name in keys if name in item}

    def __getitem__(self, idx: int) -> dict[str, Any]:
        return self._picked(dataset[idx] for dataset in self.datasets)

    def __getitems__(self, indices: Sequence[int]) -> list[dict[str, Any]]:
        """The samples of a batch."""
        parts = [_items(dataset, indices) for dataset in self.datasets]
        return [self._picked(items) for items in zip(*parts, strict=True)]

    def load_chunk(self, episodes_idx: Any, start: Any, end: Any) -> list[dict[str, Any]]:
        """See :meth:`Dataset.load_chunk`."""
        parts = [dataset.load_chunk(episodes_idx, start, end) for dataset in self.datasets]
        return [self._picked(items) for items in zip(*parts, strict=True)]

    def load_episode(self, episode_idx: int) -> dict[str, Any]:
        """See :meth:`Dataset.load_episode`."""
        return self._picked(dataset.load_episode(episode_idx) for dataset in self.datasets)

    def _load_slice(self, episode: int, start: int, end: int) -> dict[str, Any]:
        return self._picked(dataset._load_slice(episode, start, end) for dataset in self.datasets)

    @property
    def episode_column_names(self) -> list[str]:
        """See :attr:`Dataset.episode_column_names`."""
        return list(dict.fromkeys(name for dataset in self.datasets for name in dataset.episode_column_names))

    def get_episode_data(self, episodes_idx: Any = None) -> dict[str, Array]:
        """See :meth:`Dataset.get_episode_data`. Of equal names, the first dataset's value counts."""
        found: dict[str, Array] = {}
        for dataset in self.datasets:
            found = {**dataset.get_episode_data(episodes_idx), **found}
        return found

    def get_col_data(self, col: str) -> Array:
        """See :meth:`Dataset.get_col_data`."""
        for dataset, keys in zip(self.datasets, self.keys_map, strict=True):
            if col in keys:
                return np.asarray(dataset.get_col_data(col))
        raise KeyError(f"there is no column {col!r}; the columns are {', '.join(self.column_names)}")

    def get_row_data(self, row_idx: Rows) -> dict[str, Any]:
        """See :meth:`Dataset.get_row_data`."""
        return self._picked(dataset.get_row_data(row_idx) for dataset in self.datasets)


class ConcatDataset:
    """The episodes of several datasets, one after another.

    A column that has scalars in some datasets and lists of one element in others, as those from Lance, has scalars.
    """

    def __init__(self, datasets: Sequence[Any]) -> None:
        if not datasets:
            raise ValueError("ConcatDataset: expected at least one dataset")
        self.datasets = list(datasets)
        _check_same_clips("ConcatDataset", self.datasets)

    # Counted at every call, because a `ReplayBuffer` grows.

    @property
    def _now(self) -> ConcatDataset:
        """The dataset with the present content of its replay buffers, which other threads may clear."""
        return at_this_moment(self, None)  # type: ignore[no-any-return]

    @property
    def _clips_before(self) -> Array:
        return np.cumsum([0, *(len(dataset) for dataset in self.datasets)])

    @property
    def _episodes_before(self) -> Array:
        return np.cumsum([0, *(len(dataset.lengths) for dataset in self.datasets)])

    @property
    def _rows_before(self) -> Array:
        return np.cumsum([0, *(int(np.sum(dataset.lengths)) for dataset in self.datasets)])

    @property
    def column_names(self) -> list[str]:
        """The columns that at least one of the datasets has."""
        return list(dict.fromkeys(name for dataset in self.datasets for name in dataset.column_names))

    @property
    def _row_shapes(self) -> dict[str, tuple[int, ...]]:
        shapes = [_row_shapes(dataset) for dataset in self.datasets]
        return {
            name: min((of[name] for of in shapes if name in of), key=len) for name in {name for of in shapes for name in of}
        }

    def _alike(self, items: list[dict[str, Any]], axes: int = 1, *, are_grouped: bool = False) -> list[dict[str, Any]]:
        """Items of the datasets with scalars in columns that have scalars in some datasets and lists of one element in others.

        Args:
            items: Samples, episodes or rows.
            axes: The number of axes of scalars in an item.
            are_grouped: Whether actions are grouped by step, which gives them one shape.
        """
        shapes: dict[str, tuple[int, ...]] = {}
        mixed = set()
        for dataset in self.datasets:
            for name, shape in _row_shapes(dataset).items():
                other = shapes.setdefault(name, shape)
                if other != shape and {other, shape} == {(), (1,)}:
                    mixed.add(name)
        if are_grouped:
            mixed.discard("action")
        if not mixed:
            return items

        def scalars(name: str, value: Any) -> Any:
            is_list = name in mixed and getattr(value, "ndim", axes) == axes + 1 and value.shape[-1] == 1
            return value[..., 0] if is_list else value

        return [{name: scalars(name, value) for name, value in item.items()} for item in items]

    @property
    def lengths(self) -> Array:
        """The number of rows of every episode."""
        return np.concatenate([np.asarray(dataset.lengths) for dataset in self.datasets])

    @property
    def offsets(self) -> Array:
        """The index of every episode's first row in the whole dataset."""
        return np.cumsum(self.lengths) - self.lengths

    @property
    def num_episodes(self) -> int:
        """The number of episodes."""
        return int(self._episodes_before[-1])

    @property
    def num_steps(self) -> int:
        """The number of steps of a clip."""
        return int(self.datasets[0].num_steps)

    @property
    def frameskip(self) -> int:
        """The number of rows from one step to the next."""
        return int(self.datasets[0].frameskip)

    @property
    def engine(self) -> Any:
        """This dataset as an object of the engine."""
        from .foreign import engine_of

        return _engine.Dataset.concat([engine_of(dataset) for dataset in self.datasets])

    def __len__(self) -> int:
        return int(self._clips_before[-1])

    def __getitem__(self, idx: int) -> dict[str, Any]:
        return self.__getitems__([idx])[0]

    @staticmethod
    def _locate(before: Array, indices: Any, what: str) -> tuple[Array, Array]:
        """The dataset of each index, and the index in that dataset."""
        indices = _tensors.whole(what, indices)
        total = int(before[-1])
        if ((indices < -total) | (indices >= total)).any():
            raise IndexError(f"some of the {what} {indices.tolist()} are outside the dataset, which has {total} {what}")
        indices = np.where(indices < 0, indices + total, indices)
        parts = np.searchsorted(before, indices, side="right") - 1
        return parts, indices - before[parts]

    def __getitems__(self, indices: Sequence[int]) -> list[dict[str, Any]]:
        """The samples of a batch."""
        now = self._now
        parts, indices_in_part = self._locate(now._clips_before, indices, "clips")
        found = self._gathered(parts, lambda part, mask: _items(now.datasets[part], indices_in_part[mask].tolist()))
        return now._alike(found, are_grouped=True)

    def load_chunk(self, episodes_idx: Any, start: Any, end: Any) -> list[dict[str, Any]]:
        """See :meth:`Dataset.load_chunk`."""
        now = self._now
        episodes, starts, ends = _runs(episodes_idx, start, end)
        parts, episodes = self._locate(now._episodes_before, episodes, "episodes")
        found = self._gathered(
            parts, lambda part, mask: now.datasets[part].load_chunk(episodes[mask], starts[mask], ends[mask])
        )
        return now._alike(found, are_grouped=True)

    @staticmethod
    def _gathered(parts: Array, load: Callable[[int, Array], list[dict[str, Any]]]) -> list[dict[str, Any]]:
        found: dict[int, dict[str, Any]] = {}
        for part in np.unique(parts).tolist():
            mask = np.flatnonzero(parts == part)
            found.update(zip(mask.tolist(), load(part, mask), strict=True))
        return [found[i] for i in range(len(parts))]

    def load_episode(self, episode_idx: int) -> dict[str, Any]:
        """See :meth:`Dataset.load_episode`."""
        now = self._now
        parts, episodes = self._locate(now._episodes_before, [episode_idx], "episodes")
        return now._alike([dict(now.datasets[int(parts[0])].load_episode(int(episodes[0])))])[0]

    def _load_slice(self, episode: int, start: int, end: int) -> dict[str, Any]:
        now = self._now
        parts, episodes = self._locate(now._episodes_before, [episode], "episodes")
        return now._alike([dict(now.datasets[int(parts[0])]._load_slice(int(episodes[0]), start, end))])[0]

    @property
    def clip_indices(self) -> list[tuple[int, int]]:
        """The episode and the first row of every clip."""
        now = self._now
        pairs = zip(now._episodes_before.tolist(), now.datasets, strict=False)
        return [(before + episode, start) for before, dataset in pairs for episode, start in dataset.clip_indices]

    @property
    def episode_column_names(self) -> list[str]:
        """The values that the episodes of all datasets have."""
        names = [dataset.episode_column_names for dataset in self.datasets]
        return [name for name in names[0] if all(name in others for others in names)]

    def get_episode_data(self, episodes_idx: Any = None) -> dict[str, Array]:
        """See :meth:`Dataset.get_episode_data`."""
        now = self._now
        wanted = np.arange(now.num_episodes) if episodes_idx is None else np.asarray(episodes_idx).reshape(-1)
        parts, episodes = self._locate(now._episodes_before, wanted, "episodes")
        found = [now.datasets[part].get_episode_data([episode]) for part, episode in zip(parts, episodes, strict=True)]
        return _tensors.episode_table([{name: value[0] for name, value in one.items()} for one in found])

    def get_col_data(self, col: str) -> Array:
        """See :meth:`Dataset.get_col_data`."""
        having = [dataset for dataset in self.datasets if col in dataset.column_names]
        if not having:
            raise KeyError(f"there is no column {col!r}; the columns are {', '.join(self.column_names)}")
        if len(having) < len(self.datasets):
            problem = (
                f"{len(having)} of {len(self.datasets)} datasets have column {col!r}: rows are those of their episodes only"
            )
            warnings.warn(f"get_col_data: {problem}, which `offsets` does not count", stacklevel=2)
        found = self._alike([{col: np.asarray(dataset.get_col_data(col))} for dataset in having])
        return np.concatenate([rows[col] for rows in found])

    def get_row_data(self, row_idx: Rows) -> dict[str, Any]:
        """See :meth:`Dataset.get_row_data`."""
        now = self._now
        parts, rows = self._locate(now._rows_before, np.atleast_1d(np.asarray(row_idx)), "rows")
        if not len(rows):
            # Columns without rows, as the first dataset has them.
            return dict(now._alike([now.datasets[0].get_row_data([])])[0])
        found = [now.datasets[part].get_row_data(row) for part, row in zip(parts.tolist(), rows.tolist(), strict=True)]
        found = now._alike(found, axes=0)
        if np.ndim(row_idx) == 0:
            return dict(found[0])
        if any(row.keys() != found[0].keys() for row in found):
            names = [sorted(row) for row in found]
            problem = f"some rows have other columns: {next(other for other in names if other != names[0])} and {names[0]}"
            raise KeyError(f"get_row_data: {problem}; get them one by one, or join datasets with equal columns")
        return {name: np.stack([row[name] for row in found]) for name in found[0]}


def _row_shapes(dataset: Any) -> dict[str, tuple[int, ...]]:
    """The shapes of a row of the columns of a dataset, which may be of a user-defined class, as far as they are known."""
    shapes: dict[str, tuple[int, ...]] = getattr(dataset, "_row_shapes", {})
    return shapes


def transforms_of(dataset: Any) -> list[Transform]:
    """The transforms of a dataset, or of the datasets that it joins."""
    if isinstance(dataset, (MergeDataset, ConcatDataset)):
        return [transform for part in dataset.datasets for transform in transforms_of(part)]
    transform = getattr(dataset, "transform", None)
    return [] if transform is None else [transform]


def joins_episodes(dataset: Any) -> bool:
    """Whether the transform of a sample depends on its episode, because a :class:`ConcatDataset` joins several datasets."""
    if isinstance(dataset, MergeDataset):
        return any(joins_episodes(part) for part in dataset.datasets)
    return isinstance(dataset, ConcatDataset)


def transformed(dataset: Any, sample: dict[str, Any], episode: int) -> dict[str, Any]:
    """A sample that the engine read, with the transforms of `dataset[i]`."""
    if isinstance(dataset, ConcatDataset):
        parts, episodes = dataset._locate(dataset._episodes_before, [episode], "episodes")
        return dataset._alike([transformed(dataset.datasets[int(parts[0])], sample, int(episodes[0]))])[0]
    if isinstance(dataset, MergeDataset):
        columns = set(dataset.column_names)
        found = {name: value for name, value in sample.items() if name not in columns}
        for part, keys in zip(dataset.datasets, dataset.keys_map, strict=True):
            own = transformed(part, {name: sample[name] for name in keys if name in sample}, episode)
            found.update((name, own[name]) for name in keys if name in own)
        return found
    # The engine has scalars where some datasets have lists of one element.
    for name, (_, shape) in getattr(dataset, "schema", {}).items():
        if shape == (1,) and name in sample and sample[name].ndim == 1:
            sample[name] = sample[name][:, None]
    transform = getattr(dataset, "transform", None)
    return sample if transform is None else dict(transform(sample))


def _items(dataset: Any, indices: Sequence[int]) -> list[dict[str, Any]]:
    if hasattr(dataset, "__getitems__"):
        return list(dataset.__getitems__(indices))
    return [dataset[i] for i in indices]


def at_this_moment(dataset: Any, last: Any) -> Any:
    """The dataset with the present content of its replay buffers; `last`, which this returned before, if none has changed."""
    if not isinstance(dataset, (MergeDataset, ConcatDataset)):
        return dataset._at_this_moment(last) if hasattr(type(dataset), "_at_this_moment") else dataset
    before = last.datasets if type(last) is type(dataset) else [None] * len(dataset.datasets)
    parts = [at_this_moment(part, known) for part, known in zip(dataset.datasets, before, strict=True)]
    for known in (dataset, last):
        if known is not None and all(a is b for a, b in zip(parts, known.datasets, strict=True)):
            return known
    content = copy.copy(dataset)
    content.datasets = parts
    return content


class _GoalClips(NamedTuple):
    """The clips of a :class:`GoalDataset`."""

    #: The dataset, or the content of a replay buffer at a moment.
    content: Any
    #: The indices of the clips in the dataset, with their episodes and first rows.
    indices: Array
    clips: Array
    #: The number of rows of every episode, and the rows before it.
    lengths: Array
    rows_before: Array


class GoalDataset:
    """A dataset whose samples have a goal: a row of the dataset, `(1, ...)`.

    The goal is a random row of the dataset, a later step of the episode (nearer steps more likely, or all steps equally
    likely), or the current step. Clips without a later step are left out if the goal can be a later step, and clips whose
    current step is beyond the episode. The clips of a :class:`ReplayBuffer` are those of its content at each call.

    Args:
        dataset: The dataset.
        goal_probabilities: The probabilities of a random row, a later step at a geometrically distributed distance, a
            uniformly distributed later step, and the current step.
        gamma: The discount of the geometric distribution: the goal is `k` steps ahead with probability
            `(1 - gamma) * gamma**(k - 1)`. A distance beyond the episode selects the last step.
        current_goal_offset: The current step, counted from 1 at the clip's first one; the clip's last step for `None`.
        goal_keys: The columns to load from the goal row, and their names in the sample; `pixels` and `proprio` for `None`.
            Columns that samples do not have are left out, with a warning.
        seed: The seed of goals, combined with the epoch and the sample's index. Goals are random for `None`.
    """

    def __init__(
        self,
        dataset: Any,
        goal_probabilities: Sequence[float] = (0.3, 0.5, 0.0, 0.2),
        gamma: float = 0.99,
        current_goal_offset: int | None = None,
        goal_keys: Mapping[str, str] | None = None,
        seed: int | None = None,
    ) -> None:
        total = sum(goal_probabilities)
        if len(goal_probabilities) != 4 or min(goal_probabilities) < 0 or not np.isclose(total, 1.0):
            raise ValueError(
                "goal_probabilities: expected the chances (random, geometric future, uniform future, current), "
                f"which add up to 1, got {tuple(goal_probabilities)}"
            )
        if not 0 <= gamma < 1:
            raise ValueError(f"gamma: expected at least 0 and below 1, got {gamma}")
        self.dataset = dataset
        # Rounded thirds add up to 1 only nearly, which draws do not accept.
        self.goal_probabilities = tuple(float(chance / total) for chance in goal_probabilities)
        self.gamma = gamma
        offset = dataset.num_steps if current_goal_offset is None else current_goal_offset
        self.current_goal_offset = int(_tensors.whole("current_goal_offset", offset))
        if self.current_goal_offset < 1:
            raise ValueError(f"current_goal_offset: expected a step of the clip, counted from 1, got {current_goal_offset}")
        by_default = {name: f"goal_{name}" for name in ("pixels", "proprio") if name in dataset.column_names}
        self.goal_keys = dict(by_default if goal_keys is None else goal_keys)
        names, given = dataset.column_names, {} if goal_keys is None else self.goal_keys
        # Environments have columns such as `goal_state`, in whose place goals of that name are meant.
        if replaced := [goal for name, goal in given.items() if goal in names and goal != f"goal_{name}"]:
            warnings.warn(f"goal_keys: the drawn goals replace the dataset's columns {replaced} in samples", stacklevel=2)
        # The columns of an empty buffer, and those that a transform makes, are not known yet.
        known = names and not transforms_of(dataset)
        if known and (unknown := [name for name in given if name not in names]):
            warnings.warn(f"goal_keys: the dataset has no {unknown}, so samples have no such goals", stacklevel=2)
        self.seed = seed
        self.epoch = 0
        self._fresh: tuple[int, np.random.Generator] | None = None
        #: The rows from the first to the current step of a clip.
        self._ahead = (self.current_goal_offset - 1) * dataset.frameskip
        self._found: _GoalClips | None = None
        self._clips()

    def __getstate__(self) -> dict[str, Any]:
        """The attributes without the clips, which are found again."""
        return {**self.__dict__, "_found": None}

    def _clips(self) -> _GoalClips:
        """The clips that have a goal; of a replay buffer, those of its content at this moment."""
        found = self._found
        content = at_this_moment(self.dataset, None if found is None else found.content)
        if found is None or found.content is not content:
            lengths = np.asarray(content.lengths)
            clips = np.asarray(content.clip_indices, dtype=np.int64).reshape(-1, 2)
            _, geometric, uniform, _ = self.goal_probabilities
            ahead = self._ahead + (self.dataset.frameskip if geometric > 0 or uniform > 0 else 0)
            # The current step can lie beyond the clip, but not beyond the episode.
            fits = clips[:, 1] + ahead < lengths[clips[:, 0]]
            rows_before = np.cumsum([0, *lengths.tolist()])
            self._found = found = _GoalClips(content, np.flatnonzero(fits), clips[fits], lengths, rows_before)
        return found

    def set_epoch(self, epoch: int) -> None:
        """Sets the epoch, which determines the goals together with the seed.

        Workers of a `DataLoader` get it when they start: with `persistent_workers=True` they keep the first epoch.
        """
        self.epoch = int(epoch)

    @property
    def clip_indices(self) -> list[tuple[int, int]]:
        """The episode and the first row of every clip."""
        return [(int(episode), int(start)) for episode, start in self._clips().clips]

    @property
    def column_names(self) -> list[str]:
        """The columns of the dataset, without the columns of the goals."""
        return list(self.dataset.column_names)

    @property
    def lengths(self) -> Array:
        """The number of rows of every episode."""
        return np.asarray(self.dataset.lengths)

    @property
    def episode_column_names(self) -> list[str]:
        """See :attr:`Dataset.episode_column_names`."""
        return list(self.dataset.episode_column_names)

    def get_episode_data(self, episodes_idx: Any = None) -> dict[str, Array]:
        """See :meth:`Dataset.get_episode_data`."""
        return dict(self.dataset.get_episode_data(episodes_idx))

    def __len__(self) -> int:
        return len(self._clips().indices)

    def _random(self, idx: int) -> np.random.Generator:
        if self.seed is not None:
            return np.random.default_rng([self.seed, self.epoch, idx])
        # Forked workers must not share the random stream of their parent.
        if self._fresh is None or self._fresh[0] != os.getpid():
            self._fresh = (os.getpid(), np.random.default_rng())
        return self._fresh[1]

    def _draw(self, found: _GoalClips, idx: int) -> tuple[int, int]:
        """Samples the episode and the row of a goal."""
        random = self._random(idx)
        episode, start = (int(index) for index in found.clips[idx])
        now, skip = start + self._ahead, self.dataset.frameskip
        later = (int(found.lengths[episode]) - 1 - now) // skip
        kind = random.choice(4, p=self.goal_probabilities)
        if kind == 0:
            row = int(random.integers(found.rows_before[-1]))
            episode = int(np.searchsorted(found.rows_before, row, side="right")) - 1
            return episode, row - int(found.rows_before[episode])
        if kind == 1:
            return episode, now + min(int(random.geometric(max(1 - self.gamma, 1e-6))), later) * skip
        if kind == 2:
            return episode, now + int(random.integers(1, later + 1)) * skip
        return episode, now

    def __getitem__(self, idx: int) -> dict[str, Any]:
        return self.__getitems__([idx])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[dict[str, Any]]:
        """The samples of a batch."""
        indices = _tensors.whole("indices", indices).tolist()
        found = self._clips()
        content, count = found.content, len(found.indices)
        wrong = [i for i in indices if not -count <= i < count]
        if wrong:
            raise IndexError(f"clip {wrong[0]} is outside the dataset, which has {count} clips")
        indices = [i % count for i in indices]
        samples = [dict(sample) for sample in _items(content, found.indices[indices].tolist())]
        if not self.goal_keys:
            return samples
        goal_rows = np.asarray([self._draw(found, i) for i in indices])
        if isinstance(content, StoredDataset):
            goals = content._slices(goal_rows[:, 0], goal_rows[:, 1], goal_rows[:, 1] + 1)
        else:
            goals = [content._load_slice(episode, row, row + 1) for episode, row in goal_rows.tolist()]
        for sample, goal in zip(samples, goals, strict=True):
            for name, goal_name in self.goal_keys.items():
                if name in goal and name in sample:
                    sample[goal_name] = goal[name]
        return samples
