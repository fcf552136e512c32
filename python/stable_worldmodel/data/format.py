"""Formats: how layouts on disk are recognised, read and written, ours and yours.

    @register_format
    class Zarr(Format):
        name = "zarr"

        @classmethod
        def detect(cls, path): ...

        @classmethod
        def open_reader(cls, path, **kwargs): ...  # a Dataset

        @classmethod
        def open_writer(cls, path, **kwargs): ...  # a Writer

From then on `load_dataset`, `convert`, `Loader` and `World.collect(path, format="zarr")` know it.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from typing import Any, Protocol, TypeVar, runtime_checkable

__all__ = [
    "FORMATS",
    "WRITE_MODES",
    "Format",
    "Writer",
    "detect_format",
    "get_format",
    "list_formats",
    "open_writer",
    "register_format",
    "validate_write_mode",
]

#: What to do with a dataset that is there: continue it (or make one), replace it, or refuse.
WRITE_MODES = ("append", "overwrite", "error")


@runtime_checkable
class Writer(Protocol):
    """Stores episodes as they finish. A context manager: what was written is complete when it ends.

    An episode is a dict from columns to their steps, a list of them or an array `(T, ...)`; pictures are
    `(height, width, 3)` bytes. Row `t` holds the observation at `t` and the action taken from it, so the last row's
    action is missing: NaN, or -1 of integers.
    """

    def __enter__(self) -> Writer: ...
    def __exit__(self, *exc: Any) -> None: ...
    def write_episode(self, ep_data: Mapping[str, Any]) -> None:
        """Adds one episode."""

    def write_episodes(self, episodes: Iterable[Mapping[str, Any]]) -> None:
        """Adds episodes as they come."""


class Format:
    """A layout on disk. Derive from it, set `name`, implement what it can, and decorate with `register_format`."""

    #: What it is called.
    name: str = ""
    #: Whether the engine reads and writes it.
    native: bool = False

    @classmethod
    def detect(cls, path: Any) -> bool:
        """Whether a path looks like it, existing or about to be created."""
        raise NotImplementedError(f"{cls.__name__}.detect must be implemented")

    @classmethod
    def open_reader(cls, path: Any, **kwargs: Any) -> Any:
        """A :class:`~stable_worldmodel.data.Dataset` of what is there."""
        raise NotImplementedError(f"the format {cls.name or cls.__name__!r} cannot be read")

    @classmethod
    def open_writer(cls, path: Any, **kwargs: Any) -> Any:
        """A :class:`Writer`. Takes `mode`, one of :data:`WRITE_MODES`."""
        raise NotImplementedError(f"the format {cls.name or cls.__name__!r} cannot be written")


F = TypeVar("F", bound="type[Format]")

#: All formats by name.
FORMATS: dict[str, type[Format]] = {}


def register_format(cls: F) -> F:
    """Adds a format; a decorator. Defining the same class again, as notebooks do, replaces it."""
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
    """The format of a name."""
    if name not in FORMATS:
        raise ValueError(f"unknown format {name!r}; there are {', '.join(FORMATS)}")
    return FORMATS[name]


def detect_format(path: str | os.PathLike[str]) -> type[Format] | None:
    """The format that recognises a path; those registered by you are asked first."""
    ordered = sorted(FORMATS.values(), key=lambda kind: kind.native)
    return next((kind for kind in ordered if kind.detect(path)), None)


def validate_write_mode(mode: str) -> str:
    """The mode, if it is one of :data:`WRITE_MODES`."""
    if mode not in WRITE_MODES:
        raise ValueError(f"mode: expected one of {', '.join(WRITE_MODES)}, got {mode!r}")
    return mode


def open_writer(path: str | os.PathLike[str], *, format: str | None = None, mode: str = "append", **kwargs: Any) -> Any:
    """A writer into a dataset of any format: that of the name, else the one that the path says.

        with open_writer("mine.lance", mode="overwrite", codec="jpeg") as writer:
            writer.write_episode({"pixels": frames, "action": actions})

    Args:
        path: A path, a URI, or a name under `$STABLEWM_HOME/datasets`.
        format: The format's name.
        mode: `"append"` continues a dataset that is there, `"overwrite"` replaces it, `"error"` refuses.
        **kwargs: What the format's writer takes; ours take `codec`.
    """
    validate_write_mode(mode)
    kind = get_format(format) if format is not None else detect_format(path)
    if kind is None:
        kind = FORMATS["lance"]
    return kind.open_writer(path, mode=mode, **kwargs)


def foreign_writer(path: str | os.PathLike[str], format: str | None, mode: str) -> Any | None:
    """A writer of a format that the engine does not know; `None` where it writes the dataset itself."""
    kind = get_format(format) if format is not None else detect_format(path)
    return None if kind is None or kind.native else kind.open_writer(path, mode=validate_write_mode(mode))
