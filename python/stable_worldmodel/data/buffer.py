"""The latest episodes of a running collection, for training during the collection."""

from __future__ import annotations

import json
import os
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from stable_worldmodel import _engine, _options
from stable_worldmodel._forks import fork_lock

from . import _tensors
from ._tensors import NUMBERING, Array
from .dataset import Dataset, Rows, Transform
from .format import open_writer, writing

__all__ = ["ReplayBuffer", "classic_filter"]

#: The samplers that a buffer keeps: those of a training and of its evaluations.
_MOST_SAMPLERS = 4

#: `(step, buffer, batch_size, history_len) -> indices of clips`.
Sampler = Callable[[int, "ReplayBuffer", int, int], Any]


class _Content(Dataset):
    """The content of a buffer at one time.

    Another thread may write at any time: every operation of a buffer reads one such object, which nothing changes.
    """

    def __init__(self, snapshot: Any, columns: list[tuple[str, str, list[int]]], frameskip: int, num_steps: int) -> None:
        lengths = [] if snapshot is None else snapshot.lengths()
        super().__init__(lengths, np.cumsum(lengths) - lengths, frameskip, num_steps)
        self._snapshot = snapshot
        self._columns = columns

    @property
    def column_names(self) -> list[str]:
        return [name for name, _, _ in self._columns]

    @property
    def _row_shapes(self) -> dict[str, tuple[int, ...]]:
        return {name: tuple(shape) for name, _, shape in self._columns}

    @property
    def engine(self) -> Any:
        if self._snapshot is None:
            raise RuntimeError("the replay buffer is empty: write an episode first")
        return self._snapshot

    def num_valid_ends(self, history_len: int) -> int:
        return int(np.maximum(self.lengths - history_len * self.frameskip + 1, 0).sum())

    def chosen(self, indices: Array, batch_size: int, steps: int) -> dict[str, Array]:
        """The clips of `steps` steps with these indices, in the form of a batch of `sample`."""
        if indices.shape != (batch_size,):
            raise ValueError(f"the sampler gave indices of shape {indices.shape}, expected ({batch_size},)")
        view = Dataset(self.lengths, self.offsets, self.frameskip, steps)
        episodes, starts = view._clips(_tensors.whole("sampler", indices))
        found = self._read(episodes, starts, np.full(batch_size, view.span), self.frameskip)
        shapes = {name: () if name == "action" else tuple(shape) for name, _, shape in self._columns}
        return {
            name: array.reshape(batch_size, steps, *(shapes[name] or ((-1,) if name == "action" else ())))
            for name, array in found.items()
        }

    def _read(self, episodes: Array, starts: Array, lengths: Array, skip: int) -> dict[str, Array]:
        run = (np.ascontiguousarray(part, dtype=np.int64) for part in (episodes, starts, lengths))
        return dict(self.engine.read(self.column_names, *run, skip))

    def _load_slice(self, ep_idx: int, start: int, end: int) -> dict[str, Any]:
        episodes, starts, ends = (np.asarray([value]) for value in (ep_idx, start, end))
        episodes = self._counted(episodes, starts, ends)
        sample: dict[str, Any] = self._read(episodes, starts, ends - starts, self.frameskip)
        return self.transform(sample) if self.transform else sample

    def _episode_values(self, episode: int) -> dict[str, Any]:
        if not -self.num_episodes <= episode < self.num_episodes:
            raise IndexError(f"episode {episode} is outside the buffer, which has {self.num_episodes} episodes")
        return _tensors.episode_values(self.engine.constants(episode % self.num_episodes).get(_tensors.EPISODE))

    def get_col_data(self, col: str) -> Array:
        if col not in self.column_names:
            raise KeyError(f"there is no column {col!r}; the columns are {', '.join(self.column_names)}")
        all_episodes = np.arange(self.num_episodes)
        found = self.engine.read([col], all_episodes, np.zeros_like(all_episodes), self.lengths, 1)
        return np.asarray(found[col])

    def get_row_data(self, row_idx: Rows) -> dict[str, Array]:
        episodes, starts = self._rows(row_idx)
        found = self._read(episodes, starts, np.ones_like(starts), 1)
        return {name: array[0] for name, array in found.items()} if np.ndim(row_idx) == 0 else found

    def episodes(self) -> Iterator[dict[str, Any]]:
        for episode in range(self.num_episodes):
            number, start, length = (np.asarray([n]) for n in (episode, 0, self.lengths[episode]))
            values = self._episode_values(episode)
            texts = {name: text for name, text in self.engine.constants(episode).items() if name != _tensors.EPISODE}
            steps: dict[str, Any] = {**self._read(number, start, length, 1), **texts}
            yield {**steps, _tensors.EPISODE: values} if values else steps


class ReplayBuffer(Dataset):
    """The latest episodes, with at most `max_steps` rows: a writer for collection and a dataset for training.

        buffer = ReplayBuffer(max_steps=100_000, history_len=4)
        world.collect(writer=buffer, episodes=10)
        batch = buffer.sample(256)  # arrays (256, 4, ...)

    When an episode does not fit, the oldest episodes are removed. Samples depend only on the seed, the step and the content
    of the buffer.

    Several threads may write and read at once. Every call reads whole episodes of one moment; after another episode, an
    index may name another clip or episode.

    Args:
        max_steps: The maximum number of rows. An episode of `n` steps has `n + 1` rows.
        history_len: The number of steps of a clip.
        frameskip: The number of rows from one step to the next.
        sampler: A function `(step, buffer, batch_size, history_len) -> indices` that chooses clips by indices below
            `num_valid_ends(history_len)`. With `None`, all clips are equally likely.
        transform: Called with the dict of every sample of `buffer[i]`, but not with the batches of `sample`.
        key_filter: A function from the dict of a new episode to a dict of the columns to keep.
        seed: Determines the samples, together with the step.
    """

    def __init__(
        self,
        max_steps: int,
        history_len: int = 1,
        frameskip: int = 1,
        sampler: Sampler | None = None,
        transform: Transform | None = None,
        key_filter: Callable[[dict[str, Any]], dict[str, Any]] | None = None,
        seed: int = 0,
    ) -> None:
        for name, value in (("max_steps", max_steps), ("history_len", history_len), ("frameskip", frameskip)):
            if _options.whole(name, value) < 1:
                raise ValueError(f"{name}: expected at least 1, got {value}")
        super().__init__([], [], int(frameskip), int(history_len), transform)
        self.max_steps = int(max_steps)
        self.history_len = int(history_len)
        self.sampler = sampler
        self.key_filter = key_filter
        self.seed = _options.count("seed", seed, 0)
        self._buffer: Any = None
        self._columns: list[tuple[str, str, list[int]]] = []
        #: Held while the content changes, and while a sampler of the user, which may call the buffer, chooses from it.
        self._lock = fork_lock()
        #: The latest samplers of the engine's buffer, by batch size and history length. Each keeps memory for its batches.
        self._samplers: OrderedDict[tuple[int, int], Any] = OrderedDict()
        self._step = 0
        self._refresh()

    def __getstate__(self) -> dict[str, Any]:
        """The attributes, with the episodes in place of the engine's memory. A copy counts its own `num_episodes_added`."""
        gone: dict[str, Any] = {"_buffer": None, "_content": None, "_samplers": None, "_lock": None}
        return {**self.__dict__, **gone, "_episodes": list(self.episodes())}

    def __setstate__(self, state: dict[str, Any]) -> None:
        episodes = state.pop("_episodes")
        self.__dict__.update(state)
        self._lock, self._samplers = fork_lock(), OrderedDict()
        if self._columns:
            # A buffer that was cleared has no episodes, and keeps its columns.
            self._buffer = _engine.ReplayBuffer(self._columns, self.max_steps)
        self._refresh()
        filter, self.key_filter = self.key_filter, None
        self.write_episodes(episodes)
        self.key_filter = filter

    def __enter__(self) -> ReplayBuffer:
        return self

    def __exit__(self, *exc: Any) -> None:
        return None

    def write_episode(self, ep_data: Mapping[str, Any]) -> None:
        """Adds an episode: a list of steps or an array `(T, ...)` for each column, as in :class:`EpisodeWriter`."""
        if self.key_filter is not None:
            ep_data = self.key_filter(dict(ep_data))
        arrays, constants = _tensors.rows(ep_data)
        if not arrays:
            return
        with self._lock:
            before = self._columns, self._buffer
            if self._buffer is None:
                self._columns = [(name, array.dtype.name, list(array.shape[1:])) for name, array in arrays.items()]
                self._buffer = _engine.ReplayBuffer(self._columns, self.max_steps)
            missing = [name for name, _, _ in self._columns if name not in arrays]
            extra = [name for name in arrays if name not in {name for name, _, _ in self._columns}]
            if missing or extra:
                raise ValueError(f"an episode must have the buffer's columns: missing {missing}, unexpected {extra}")
            try:
                self._buffer.add({name: arrays[name] for name, _, _ in self._columns}, constants)
            except BaseException:
                # A refused episode defines no columns.
                self._columns, self._buffer = before
                raise
            self._refresh()

    def write_episodes(self, episodes: Iterable[Mapping[str, Any]]) -> None:
        """Adds several episodes."""
        for episode in episodes:
            self.write_episode(episode)

    def clear(self) -> None:
        """Removes all episodes."""
        with self._lock:
            if self._buffer is not None:
                self._buffer = _engine.ReplayBuffer(self._columns, self.max_steps)
                self._samplers.clear()
                self._refresh()

    def _refresh(self) -> None:
        """Takes the current content of the engine's buffer."""
        snapshot = None if self._buffer is None else self._buffer.snapshot()
        self._content = content = _Content(snapshot, self._columns, self.frameskip, self.num_steps)
        self.lengths, self.offsets, self.span = content.lengths, content.offsets, content.span
        self._clips_before = content._clips_before

    @property
    def _now(self) -> _Content:
        """The current content, with the transform of now."""
        content = self._content
        content.transform = self.transform
        return content

    def _at_this_moment(self, last: Any) -> Dataset:
        """What reads the current content, also after another episode; `last`, which this returned before, if it still does.

        That of a subclass is of the subclass, whose methods read as those of the buffer do.
        """
        if type(self) is ReplayBuffer:
            return self._now
        with self._lock:
            attributes = self.__dict__
            if type(last) is not type(self) or last._content is not self._content:
                last = object.__new__(type(self))
            # The user may have set attributes since.
            last.__dict__.update(attributes)
        return last  # type: ignore[no-any-return]

    @property
    def column_names(self) -> list[str]:
        return [name for name, _, _ in self._columns]

    @property
    def engine(self) -> Any:
        """The engine's dataset of the current content."""
        return self._now.engine

    @property
    def _row_shapes(self) -> dict[str, tuple[int, ...]]:
        return self._now._row_shapes

    @property
    def num_steps_stored(self) -> int:
        """The number of rows in the buffer."""
        return 0 if self._buffer is None else int(self._buffer.rows())

    @property
    def num_episodes_added(self) -> int:
        """The number of episodes added since the last `clear`, including removed episodes."""
        return 0 if self._buffer is None else int(self._buffer.added())

    def num_valid_ends(self, history_len: int | None = None) -> int:
        """The number of clips of `history_len` steps in the buffer."""
        return self._now.num_valid_ends(self.history_len if history_len is None else history_len)

    def sample(self, batch_size: int, history_len: int | None = None, step: int | None = None) -> dict[str, Array]:
        """Samples a batch of clips.

        Args:
            batch_size: The number of clips.
            history_len: The number of steps of a clip; `None` uses the value of the buffer.
            step: The index of the batch, which determines the sampled clips; `None` counts the calls.

        Returns:
            Arrays `(batch_size, history_len, ...)`; `action` is `(batch_size, history_len, frameskip * dim)`, images
            `(batch_size, history_len, H, W, C)`.
        """
        steps = self.history_len if history_len is None else _options.whole("history_len", history_len)
        batch_size = _options.whole("batch_size", batch_size)
        if batch_size < 1 or steps < 1:
            raise ValueError(f"expected a batch_size and history_len of at least 1, got {batch_size} and {steps}")
        with self._lock:
            if step is None:
                step = self._step
                self._step += 1
            content = self._now
            if content.num_valid_ends(steps) == 0:
                raise RuntimeError(
                    f"the replay buffer has no clip of {steps} steps with frameskip {self.frameskip}: it holds "
                    f"{content.num_episodes} episodes of {int(content.lengths.sum())} rows"
                )
            if self.sampler is not None:
                indices = np.asarray(self.sampler(step, self, batch_size, steps))
                return self._now.chosen(indices, batch_size, steps)
            sampler = self._engine_sampler(batch_size, steps)
        return dict(sampler.sample(step))

    def _engine_sampler(self, batch_size: int, steps: int) -> Any:
        key = (batch_size, steps)
        if key not in self._samplers:
            settings = {
                "num_steps": steps,
                "frameskip": self.frameskip,
                "columns": self.column_names,
                "goals": [],
                "batch_size": batch_size,
                "recent": None,
            }
            self._samplers[key] = self._buffer.sampler(json.dumps(settings), self.seed)
            while len(self._samplers) > _MOST_SAMPLERS:
                self._samplers.popitem(last=False)
        self._samplers.move_to_end(key)
        return self._samplers[key]

    @property
    def clip_indices(self) -> list[tuple[int, int]]:
        return self._now.clip_indices

    def __getitem__(self, idx: int) -> dict[str, Any]:
        return self._now[idx]

    def load_chunk(
        self, episodes_idx: Sequence[int] | Array, start: Sequence[int] | Array, end: Sequence[int] | Array
    ) -> list[dict[str, Any]]:
        return self._now.load_chunk(episodes_idx, start, end)

    def load_episode(self, episode_idx: int) -> dict[str, Any]:
        return self._now.load_episode(episode_idx)

    def _load_slice(self, ep_idx: int, start: int, end: int) -> dict[str, Any]:
        return self._now._load_slice(ep_idx, start, end)

    @property
    def episode_column_names(self) -> list[str]:
        return self._now.episode_column_names

    def get_episode_data(self, episodes_idx: Sequence[int] | Array | None = None) -> dict[str, Array]:
        return self._now.get_episode_data(episodes_idx)

    def get_col_data(self, col: str) -> Array:
        return self._now.get_col_data(col)

    def get_row_data(self, row_idx: Rows) -> dict[str, Array]:
        return self._now.get_row_data(row_idx)

    def episodes(self) -> Iterator[dict[str, Any]]:
        """Yields the episodes of now, oldest first, as dicts of arrays `(T, ...)`, and of the bytes of their texts."""
        return self._now.episodes()

    def dump(self, path: str | os.PathLike[str], format: str | None = None, mode: str = "overwrite", **kwargs: Any) -> None:
        """Writes the content to a dataset of any format.

        Args:
            path: A path, a URI, or a name under `$STABLEWM_HOME/datasets`.
            format: The format; `None` detects it from the path, or selects Lance.
            mode: The treatment of an existing dataset: `"overwrite"` replaces it, as in the published package, `"append"` adds
                to it, `"error"` raises. An empty buffer replaces nothing.
            **kwargs: Further arguments of `open_writer`.
        """
        with writing(open_writer(path, format=format, mode=mode, **kwargs), "write_episodes") as writer:
            writer.write_episodes(self.episodes())

    def __repr__(self) -> str:
        columns = ", ".join(self.column_names) or "none yet"
        rows = f"{self.num_steps_stored} of {self.max_steps} rows"
        return f"ReplayBuffer({self.num_episodes} episodes, {rows}, columns: {columns})"


def classic_filter(ep_data: dict[str, Any]) -> dict[str, Any]:
    """A `key_filter` that keeps `pixels`, `action`, `reward`, `terminated` and `truncated`."""
    classic = ("pixels", "action", "reward", "terminated", "truncated")
    return {name: value for name, value in ep_data.items() if name in classic and name not in NUMBERING}
