"""The engine's formats as :class:`~stable_worldmodel.data.Format` classes, and a dataset class for each."""

from __future__ import annotations

import os
from typing import Any

from stable_worldmodel import _engine

from ..dataset import StoredDataset
from ..format import Format, register_format
from ..writer import EpisodeWriter
from .named import (
    FolderDataset,
    FolderWriter,
    HDF5Dataset,
    HDF5Writer,
    ImageDataset,
    LanceDataset,
    LanceVideoDataset,
    LanceVideoWriter,
    LanceWriter,
    LeRobotAdapter,
    VideoDataset,
    VideoWriter,
)

__all__ = [
    "FolderDataset",
    "FolderWriter",
    "HDF5Dataset",
    "HDF5Writer",
    "ImageDataset",
    "LanceDataset",
    "LanceVideoDataset",
    "LanceVideoWriter",
    "LanceWriter",
    "LeRobotAdapter",
    "VideoDataset",
    "VideoWriter",
]

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

# The modules of the formats, which need the registered classes.
from . import folder, hdf5, lance, lance_video, lerobot, video  # noqa: E402, F401
