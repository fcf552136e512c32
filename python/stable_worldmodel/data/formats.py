"""The engine's formats as :class:`~stable_worldmodel.data.Format` classes, and a dataset class for each."""

from __future__ import annotations

import os
from typing import Any

from stable_worldmodel import _engine

from .dataset import StoredDataset
from .format import Format, register_format
from .writer import EpisodeWriter

__all__ = [
    "FolderDataset",
    "FolderWriter",
    "HDF5Dataset",
    "HDF5Writer",
    "ImageDataset",
    "LanceDataset",
    "LanceVideoDataset",
    "LanceWriter",
    "LeRobotAdapter",
    "VideoDataset",
    "VideoWriter",
]


class _Named(StoredDataset):
    """A dataset of one format, by name or path."""

    def __init__(self, name: Any = None, *, path: Any = None, uri: Any = None, cache_dir: Any = None, **kwargs: Any):
        from .utils import resolve

        given = next((given for given in (path, uri, name) if given is not None), None)
        if given is None:
            raise TypeError(f"{type(self).__name__}: expected a name or a path")
        super().__init__(resolve(given, cache_dir), **kwargs)


class LanceDataset(_Named):
    """A Lance table."""

    format = "lance"


class LanceVideoDataset(_Named):
    """A Lance table with images in separate video files."""

    format = "lance-video"


class HDF5Dataset(_Named):
    """An HDF5 file."""

    format = "hdf5"


class VideoDataset(_Named):
    """A folder of numeric columns and videos."""

    format = "video"


class FolderDataset(_Named):
    """A folder of numeric columns and image files."""

    format = "folder"


class ImageDataset(FolderDataset):
    """A folder of numeric columns and image files."""


class LeRobotAdapter(_Named):
    """A LeRobot dataset."""

    format = "lerobot"


class LanceWriter(EpisodeWriter):
    """Writes a Lance table."""

    format = "lance"


class HDF5Writer(EpisodeWriter):
    """Writes an HDF5 file."""

    format = "hdf5"


class VideoWriter(EpisodeWriter):
    """Writes a folder of numeric columns and videos."""

    format = "video"


class FolderWriter(EpisodeWriter):
    """Writes a folder of numeric columns and image files."""

    format = "folder"


_READERS: dict[str, type[StoredDataset]] = {
    str(kind.format): kind
    for kind in (LanceDataset, LanceVideoDataset, HDF5Dataset, VideoDataset, FolderDataset, LeRobotAdapter)
}


class _Native(Format):
    native = True

    @classmethod
    def detect(cls, path: Any) -> bool:
        return bool(_engine.detect(os.fspath(path)) == cls.name)

    @classmethod
    def open_reader(cls, path: Any, **kwargs: Any) -> StoredDataset:
        return _READERS.get(cls.name, StoredDataset)(path, **{"format": cls.name, **kwargs})

    @classmethod
    def open_writer(cls, path: Any, **kwargs: Any) -> EpisodeWriter:
        return EpisodeWriter(path, format=cls.name, **kwargs)


for _name in _engine.formats():
    register_format(type(_name.title().replace("-", ""), (_Native,), {"name": _name, "__module__": __name__}))
