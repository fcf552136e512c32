"""A writer of episodes into datasets of the engine's formats."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stable_worldmodel import _engine
from stable_worldmodel._forks import fork_lock

from . import _tensors
from ._tensors import NUMBERING, Array
from .format import validate_write_mode

__all__ = ["EpisodeWriter"]


#: The formats that store images without loss, whatever the codec: those without `codecs` in the engine's registry.
_LOSSLESS = ("hdf5",)


def codec_json(codec: str | None, quality: int | None = None, format: str | None = None) -> str | None:
    """The image codec as JSON for the engine: `"qoi"` or `"png"` (lossless), `"jpeg"` or `"jpeg-QUALITY"`.

    Raises:
        ValueError: If it is none of these, or JPEG for a format that stores images without loss.
    """
    if codec is None:
        if quality is None:
            return None
        codec = "jpeg"
    if not isinstance(codec, str):
        raise TypeError(f"codec: expected 'qoi', 'png' or 'jpeg-QUALITY', got {codec!r}")
    name, _, given = codec.lower().replace(":", "-").partition("-")
    name = {"lossless": "qoi", "jpg": "jpeg"}.get(name, name)
    if name == "jpeg" and format in _LOSSLESS:
        raise ValueError(f"codec: the format {format} stores images without loss; leave it out, or choose another format")
    if name == "jpeg" and (not given or given.isdigit()):
        return json.dumps({"jpeg": {"quality": int(given or (95 if quality is None else quality))}})
    if name not in ("qoi", "png") or given:
        raise ValueError(f"codec: expected 'qoi' or 'png' (lossless), 'jpeg' or 'jpeg-QUALITY', got {codec!r}")
    return json.dumps(name)


class EpisodeWriter:
    """Writes episodes into a dataset: a :class:`~stable_worldmodel.data.Writer`.

    The first episode defines the columns. The writer commits episodes at least every two seconds and when it is closed.
    Committed episodes remain if the process is killed. Several threads may write episodes at once.

    Args:
        path: A path, a URI, or a name under `$STABLEWM_HOME/datasets`.
        format: The format; `None` detects it from the path, or selects Lance.
        mode: `"append"` continues an existing dataset, `"overwrite"` replaces it at the first episode, `"error"` raises.
        codec: The codec of images: `"qoi"` (lossless, the default), `"png"`, `"jpeg"` or `"jpeg-QUALITY"`.
        jpeg_quality: The quality of the codec `"jpeg"`, as in `codec="jpeg-QUALITY"`.
        manifest: The provenance of the data, stored in the dataset's manifest under the key `config`.
    """

    #: The format of this class's datasets; detected from the path for `None`.
    format: str | None = None

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        format: str | None = None,
        mode: str = "append",
        codec: str | None = None,
        jpeg_quality: int | None = None,
        manifest: Mapping[str, Any] | None = None,
    ) -> None:
        self.mode = validate_write_mode(mode)
        if format is not None:
            self.format = format
        self.path = _engine.target(os.fspath(path), self.format)
        if self.format is None:
            self.format = _engine.detect(self.path) or "lance"
        self._codec = codec_json(codec, jpeg_quality, self.format)
        self._manifest = None if manifest is None else self._provenance(manifest)
        #: Held while an episode is written, because the first one opens the dataset.
        self._lock = fork_lock()
        #: The process that writes: that of the first episode.
        self._process: int | None = None
        self._writer: Any = None
        self._closed = self._warned = False
        #: The columns and their types, once they are known.
        self._columns: dict[str, tuple[str, tuple[int, ...]]] = {}
        location = Path(self.path)
        exists = "://" not in self.path and location.exists() and not _engine.has_no_dataset(self.path)
        if exists and mode == "error":
            raise FileExistsError(
                f"{self.path}: there is a dataset already; continue it (mode='append') or replace it (mode='overwrite')"
            )
        if exists and mode == "append":
            _engine.recover(self.path)
            schema = _engine.Dataset(self.path, self.format, None).schema()
            self._columns = {name: (dtype, tuple(shape)) for name, dtype, shape in schema if name not in NUMBERING}

    @staticmethod
    def _provenance(given: Mapping[str, Any]) -> str:
        if "kind" in given and "config" in given:
            return json.dumps(dict(given))
        from stable_worldmodel._engine import __version__

        empty: dict[str, str] = {}
        made = {"kind": "write", "swm_version": __version__, "libraries": empty, "seed": 0, "hashes": empty}
        return json.dumps({**made, "config": dict(given), "device": "cpu"})

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_lock": None, "_process": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _lock=fork_lock())

    @property
    def num_episodes(self) -> int:
        """The number of episodes in the dataset, including uncommitted ones; 0 before the first episode is written."""
        return 0 if self._writer is None else int(self._writer.episodes() or 0)

    def write_episode(self, ep_data: Mapping[str, Any]) -> None:
        """Adds an episode: a list of steps or an array `(T, ...)` for each column.

        Row `t` holds the observation at `t` and the action taken from it. The action of the last row is missing: NaN, -1 for
        integers, or one action fewer. An action in the last row is left out, with a warning, because no observation
        follows it. Actions of `uint8` and `bool` need all rows, and the last one is stored, with a warning.
        """
        self._check_process()
        with self._lock:
            if self._closed:
                raise ValueError(f"{self.path}: the writer is closed; open another one with mode='append'")
            arrays, constants = _tensors.rows(ep_data)
            if not arrays:
                raise ValueError("an episode needs at least one numeric column")
            if _tensors.without_last_action(arrays) and not self._warned:
                self._warned = True
                warnings.warn(f"{self.path}: {_tensors.LAST_ACTION}", stacklevel=2)
            if _tensors.keeps_last_action(arrays) and not self._warned:
                self._warned = True
                warnings.warn(f"{self.path}: {_tensors.LAST_ACTION_STAYS}; convert them to int32", stacklevel=2)
            known = self._columns
            if not known:
                self._columns = {name: (array.dtype.name, array.shape[1:]) for name, array in arrays.items()}
            try:
                fitted = self._fitted(arrays)
                if self._writer is None:
                    columns = [(name, dtype, list(shape)) for name, (dtype, shape) in self._columns.items()]
                    self._process = os.getpid()
                    self._writer = _engine.Writer(self.path, self.format, self.mode, self._codec, columns, self._manifest)
            except BaseException:
                # A refused episode defines no columns.
                self._columns = known
                raise
            try:
                self._writer.write(fitted, constants)
            except BaseException:
                if self.mode == "overwrite" and not self._writer.episodes():
                    # To close a writer without episodes would replace the old dataset by an empty one.
                    self._writer = None
                raise

    def _check_process(self) -> None:
        """Refuses a process that was forked from the one that writes: it lacks the threads, and writes to the same files."""
        if self._process not in (None, os.getpid()):
            raise ValueError(
                f"{self.path}: the writer began to write before this process was forked; open one in the process that writes"
            )

    def _fitted(self, arrays: Mapping[str, Array]) -> dict[str, Array]:
        """The episode with the columns of the dataset, in their order and types."""
        missing = [name for name in self._columns if name not in arrays]
        extra = [name for name in arrays if name not in self._columns]
        if missing or extra:
            raise ValueError(f"{self.path}: an episode must have the dataset's columns: missing {missing}, unexpected {extra}")
        fitted = {}
        for name, (dtype, shape) in self._columns.items():
            array = arrays[name]
            # Some sources store scalar columns as lists of one element.
            if array.shape[1:] != shape and array[:1].size == int(np.prod(shape)) and max(array.ndim - 1, len(shape)) <= 1:
                array = array.reshape(len(array), *shape)
            if array.shape[1:] != shape:
                raise ValueError(
                    f"{self.path}: column {name!r} has steps of shape {array.shape[1:]}, expected {shape} as in the dataset"
                )
            if array.dtype.name != dtype and not np.can_cast(array.dtype, dtype, "same_kind"):
                raise TypeError(f"{self.path}: column {name!r} is {array.dtype.name}, expected {dtype} as in the dataset")
            fitted[name] = _tensors.exact(f"{self.path}: column {name!r}", array, dtype)
        return fitted

    def write_episodes(self, episodes: Iterable[Mapping[str, Any]]) -> None:
        """Adds several episodes."""
        for episode in episodes:
            self.write_episode(episode)

    def close(self) -> None:
        """Commits the episodes and closes the writer."""
        self._check_process()
        with self._lock:
            self._closed = True
            if self._writer is not None:
                self._writer.finish()

    def __enter__(self) -> EpisodeWriter:
        return self

    def __exit__(self, *exc: Any) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.path!r}, format={self.format!r}, mode={self.mode!r})"
