"""Formats: detection, reading and writing of storage layouts, native and user-defined.

    @register_format
    class Zarr(Format):
        name = "zarr"

        @classmethod
        def detect(cls, path): ...

        @classmethod
        def open_reader(cls, path, **kwargs): ...  # a Dataset

        @classmethod
        def open_writer(cls, path, **kwargs): ...  # a Writer

Afterwards `load_dataset`, `convert`, `Loader` and `World.collect(path, format="zarr")` support the format.
"""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Protocol, TypeVar, runtime_checkable

from ._tensors import EPISODE

__all__ = [
    "EPISODE_DATA_KEY",
    "FORMATS",
    "WRITE_MODES",
    "Format",
    "Writer",
    "detect_format",
    "get_format",
    "list_formats",
    "open_writer",
    "register_format",
    "split_episode_data",
    "validate_write_mode",
]

#: The treatment of an existing dataset: append to it (or create one), replace it, or raise an error.
WRITE_MODES = ("append", "overwrite", "error")


#: The key of an episode's own values, which have no step: a dict of numbers, arrays and texts.
EPISODE_DATA_KEY = EPISODE


def split_episode_data(ep_data: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The columns of an episode's steps, and the values under `EPISODE_DATA_KEY`, which belong to the whole episode."""
    steps = dict(ep_data)
    episode = steps.pop(EPISODE_DATA_KEY, None) or {}
    if not isinstance(episode, Mapping):
        raise TypeError(f"{EPISODE_DATA_KEY!r}: expected a dict of the episode's values, got {type(episode).__name__}")
    return steps, dict(episode)


@runtime_checkable
class Writer(Protocol):
    """Stores finished episodes. A context manager: the dataset is complete when the context ends.

    Episodes go to what `__enter__` returns, or to the writer itself if that lacks the method.

    An episode is a dict with a list of steps or an array `(T, ...)` for each column; images are `(H, W, 3)` of
    `uint8`. Row `t` holds the observation at `t` and the action taken from it. The action of the last row is missing: NaN,
    or -1 for integers.
    """

    def __enter__(self) -> Writer: ...
    def __exit__(self, *exc: Any) -> None: ...
    def write_episode(self, ep_data: Mapping[str, Any]) -> None:
        """Adds one episode."""

    def write_episodes(self, episodes: Iterable[Mapping[str, Any]]) -> None:
        """Adds several episodes."""


class Format:
    """A storage layout. Subclasses set `name`, implement the supported methods, and use `register_format`."""

    #: The name of the format.
    name: str = ""
    #: Whether the engine implements the format.
    native: bool = False

    @classmethod
    def detect(cls, path: Any) -> bool:
        """Whether a path, existing or not, belongs to this format."""
        raise NotImplementedError(f"{cls.__name__}.detect must be implemented")

    @classmethod
    def open_reader(cls, path: Any, **kwargs: Any) -> Any:
        """A :class:`~stable_worldmodel.data.Dataset` of the path."""
        raise NotImplementedError(f"the format {cls.name or cls.__name__!r} cannot be read")

    @classmethod
    def open_writer(cls, path: Any, **kwargs: Any) -> Any:
        """A :class:`Writer`. Takes `mode`, one of :data:`WRITE_MODES`."""
        raise NotImplementedError(f"the format {cls.name or cls.__name__!r} cannot be written")


F = TypeVar("F", bound="type[Format]")

#: All formats by name.
FORMATS: dict[str, type[Format]] = {}


def register_format(cls: F) -> F:
    """Registers a format; a decorator. Defining the same class again (module and qualified name) replaces it."""
    name = getattr(cls, "name", None)
    if not name:
        raise ValueError(f"{cls.__name__}: a format needs a `name`")
    known = FORMATS.get(name)
    if known is not None and (known.__module__, known.__qualname__) != (cls.__module__, cls.__qualname__):
        raise ValueError(f"the format {name!r} is registered already, as {known.__module__}.{known.__qualname__}")
    FORMATS[name] = cls
    return cls


def list_formats() -> list[str]:
    """The names of all formats."""
    return list(FORMATS)


def get_format(name: str) -> type[Format]:
    """The format with this name."""
    if name not in FORMATS:
        raise ValueError(f"unknown format {name!r}; the formats are {', '.join(FORMATS)}")
    return FORMATS[name]


def detect_format(path: str | os.PathLike[str]) -> type[Format] | None:
    """The format of a path; user-defined formats take precedence. `lerobot://OWNER/NAME` names a LeRobot dataset."""
    if os.fspath(path).startswith("lerobot://"):
        return FORMATS["lerobot"]
    found = detect_user_format(path)
    return found or next((kind for kind in FORMATS.values() if kind.native and kind.detect(path)), None)


def detect_user_format(path: str | os.PathLike[str]) -> type[Format] | None:
    """The user-defined format of a path, if there is one."""
    return next((kind for kind in FORMATS.values() if not kind.native and kind.detect(path)), None)


def validate_write_mode(mode: str) -> str:
    """The mode, if it is one of :data:`WRITE_MODES`."""
    if mode not in WRITE_MODES:
        raise ValueError(f"mode: expected one of {', '.join(WRITE_MODES)}, got {mode!r}")
    return mode


def open_writer(path: str | os.PathLike[str], *, format: str | None = None, mode: str = "append", **kwargs: Any) -> Any:
    """Opens a writer of a dataset.

        with open_writer("mine.lance", mode="overwrite", codec="jpeg") as writer:
            writer.write_episode({"pixels": frames, "action": actions})

    Args:
        path: A path, a URI, or a name under `$STABLEWM_HOME/datasets`.
        format: The format's name. `None` detects it from the path, and uses Lance if no format matches.
        mode: `"append"` continues an existing dataset, `"overwrite"` replaces it, `"error"` raises.
        **kwargs: Arguments of the format's writer; writers of native formats take `codec`.
    """
    validate_write_mode(mode)
    kind = get_format(format) if format is not None else detect_format(path)
    if kind is None:
        kind = FORMATS["lance"]
    return kind.open_writer(path, mode=mode, **kwargs) if kind.native else open_foreign(kind, path, mode, **kwargs)


def open_foreign(kind: type[Format], path: Any, mode: str, **kwargs: Any) -> Any:
    """Opens a writer of a user-defined format.

    Raises:
        FileExistsError: If the mode is `"error"`, and there is a file, or a folder that is not empty.
    """
    # Not left to the user's writer, because the default must not replace anything.
    if validate_write_mode(mode) == "error":
        check_free(path)
    return kind.open_writer(path, mode=mode, **kwargs)


@contextlib.contextmanager
def writing(writer: Any, method: str) -> Iterator[Any]:
    """Enters a writer, which may be a user's.

    Yields:
        What its `__enter__` returns, or the writer itself if that lacks `method`, which is to be called.

    Raises:
        TypeError: If both lack it.
        BaseException: The error of the block, also if the writer suppresses it: there is no result to report.
    """
    failed: BaseException | None = None
    with writer as entered:
        try:
            able = next((one for one in (entered, writer) if hasattr(one, method)), None)
            if able is None:
                kind = type(writer if entered is None else entered).__name__
                raise TypeError(f"writer: {kind} has no {method}, which is called with episodes; give it that method")
            yield able
        except BaseException as error:
            failed = error
            raise
    if failed is not None:
        raise failed


def foreign_episodes(path: str | os.PathLike[str], format: str | None, mode: str) -> int:
    """The number of episodes of a user-defined format that a collection with this mode continues after; 0 for other formats.

    Raises:
        ValueError: If the dataset cannot be read, and the collection resumes.
    """
    kind = user_defined(path, format)
    if kind is None or mode not in ("resume", "append"):
        return 0
    text = os.fspath(path)
    try:
        return len(episode_lengths(kind.open_reader(path)))
    except Exception as error:
        # A dataset that is there may lack a file of its own.
        if isinstance(error, FileNotFoundError) if "://" in text else is_free(text):
            return 0
        why = f"{text}: the reader of the format {kind.name!r} does not tell the number of episodes ({error})"
        if mode == "resume":
            raise ValueError(f"{why}, so the collection cannot resume; use mode='append' or mode='overwrite'") from error
        warnings.warn(f"{why}, so the collection starts again with its first episode; use another seed", stacklevel=3)
        return 0


def check_free(path: Any, problem: str = "") -> None:
    """Checks that a target is free.

    Args:
        path: The target.
        problem: What to add to the error.

    Raises:
        FileExistsError: If there is a file, or a folder that is not empty.
    """
    if not is_free(path):
        there = f"{path}: there is a dataset already{problem}"
        raise FileExistsError(f"{there}; add to it (mode='append') or replace it (mode='overwrite')")


def is_free(path: Any) -> bool:
    """Whether a path has nothing, or an empty folder. What only its format can look up (a URI, or no path) counts as free."""
    if not isinstance(path, (str, os.PathLike)):
        return True
    path = os.fspath(path)
    return "://" in path or not os.path.lexists(path) or (os.path.isdir(path) and not os.listdir(path))


def episode_lengths(reader: Any, is_kept: bool = False) -> list[int]:
    """The number of rows of every episode of a user's reader.

    Args:
        reader: The reader.
        is_kept: Whether others may read its lengths again.

    Raises:
        TypeError: If `lengths` is not a sequence, or an iterator that a second call would find empty, and the reader is kept.
        ValueError: If one of them is not a whole number of at least 0.
    """
    given = reader.lengths
    can_be_read_once = is_kept and isinstance(given, Iterator) and reader.lengths is given
    is_sequence = hasattr(given, "__iter__") or hasattr(given, "__getitem__")
    if can_be_read_once or not is_sequence or isinstance(given, (str, bytes, Mapping)):
        kind = "an iterator, which can be read only once" if can_be_read_once else f"{given!r:.80}"
        raise TypeError(f"lengths: expected a list of the number of rows of every episode, got {kind}; correct the reader")
    return [_length(episode, length) for episode, length in enumerate(given)]


def _length(episode: int, given: Any) -> int:
    with contextlib.suppress(TypeError, ValueError, OverflowError):
        rows = int(given)
        if rows == given and rows >= 0:
            return rows
    raise ValueError(
        f"lengths[{episode}]: expected a whole number of rows of at least 0, got {given!r:.80}; correct the reader"
    )


def user_defined(path: str | os.PathLike[str], format: str | None) -> type[Format] | None:
    """The user-defined format of a path; `None` for formats of the engine."""
    kind = get_format(format) if format is not None else detect_format(path)
    return None if kind is None or kind.native else kind
