"""The dataset and writer classes of the engine's formats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..dataset import StoredDataset, Transform
from ..writer import EpisodeWriter

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

#: The columns to add: a dict from target to source.
Merged = Mapping[str, list[str] | str]


class _Named(StoredDataset):
    """A dataset of one format, by name or path. The other arguments are those of `StoredDataset`."""

    def _open_named(self, given: Sequence[Any], cache_dir: Any, **settings: Any) -> None:
        from ..utils import resolve

        name = next((name for name in given if name is not None), None)
        if name is None:
            raise TypeError(f"{type(self).__name__}: expected a name or a path")
        StoredDataset.__init__(self, resolve(name, cache_dir), **settings)


class HDF5Dataset(_Named):
    """An HDF5 file, local or at a URI. Credentials of object stores come from the environment, not `storage_options`."""

    format = "hdf5"

    def __init__(
        self,
        name: Any = None,
        frameskip: int = 1,
        num_steps: int = 1,
        transform: Transform | None = None,
        keys_to_load: Sequence[str] | None = None,
        keys_to_cache: Sequence[str] | None = None,
        keys_to_merge: Merged | None = None,
        cache_dir: Any = None,
        path: Any = None,
        storage_options: Any = None,
        **kwargs: Any,
    ) -> None:
        kwargs |= {"keys_to_cache": keys_to_cache, "keys_to_merge": keys_to_merge, "keys_to_load": keys_to_load}
        given = (path, kwargs.pop("uri", None), name)
        self._open_named(given, cache_dir, frameskip=frameskip, num_steps=num_steps, transform=transform, **kwargs)

    @property
    def is_remote(self) -> bool:
        """Whether the file is read from an object store."""
        return "://" in self.path


class FolderDataset(_Named):
    """A folder of numeric columns and image files. Image columns are found, `folder_keys` need not name them."""

    format = "folder"

    def __init__(
        self,
        name: Any = None,
        frameskip: int = 1,
        num_steps: int = 1,
        transform: Transform | None = None,
        keys_to_load: Sequence[str] | None = None,
        folder_keys: Sequence[str] | None = None,
        cache_dir: Any = None,
        path: Any = None,
        **kwargs: Any,
    ) -> None:
        kwargs["keys_to_load"] = keys_to_load
        given = (path, kwargs.pop("uri", None), name)
        self._open_named(given, cache_dir, frameskip=frameskip, num_steps=num_steps, transform=transform, **kwargs)


class ImageDataset(FolderDataset):
    """A folder of numeric columns and image files."""

    def __init__(self, name: Any = None, image_keys: Sequence[str] | None = None, **kw: Any) -> None:
        super().__init__(name, folder_keys=image_keys, **kw)


class VideoDataset(FolderDataset):
    """A folder of numeric columns and videos."""

    format = "video"

    def __init__(self, name: Any = None, video_keys: Sequence[str] | None = None, **kw: Any) -> None:
        super().__init__(name, folder_keys=video_keys, **kw)


class LanceDataset(_Named):
    """A Lance table, local or at a URI.

    Args:
        path: A path or name, or the folder of the table `table_name`.
        table_name: The name of the table in the folder `path`, without its suffix.
        uri: A URI.
        frameskip, num_steps, transform, keys_to_load, keys_to_cache, keys_to_merge: As for `StoredDataset`.
        image_columns: Ignored: image columns are found.
        episode_index_column, step_index_column: Must have their defaults.
        connect_kwargs: Must be empty: credentials of object stores come from the environment.
        **kwargs: Further arguments of `StoredDataset`, and `cache_dir`, a folder in place of `$STABLEWM_HOME`.
    """

    format = "lance"

    def __init__(
        self,
        path: Any = None,
        table_name: str | None = None,
        *,
        uri: Any = None,
        frameskip: int = 1,
        num_steps: int = 1,
        transform: Transform | None = None,
        keys_to_load: Sequence[str] | None = None,
        keys_to_cache: Sequence[str] | None = None,
        keys_to_merge: Merged | None = None,
        image_columns: Sequence[str] | None = None,
        episode_index_column: str = "episode_idx",
        step_index_column: str = "step_idx",
        connect_kwargs: Any = None,
        **kwargs: Any,
    ) -> None:
        if (episode_index_column, step_index_column) != ("episode_idx", "step_idx"):
            raise ValueError("LanceDataset: the index columns are called episode_idx and step_idx; rename them in the table")
        location = path if path is not None else uri
        if table_name is not None and location is not None:
            location = f"{str(location).rstrip('/')}/{table_name}.lance"
        kwargs |= {"keys_to_cache": keys_to_cache, "keys_to_merge": keys_to_merge, "keys_to_load": keys_to_load}
        given = (location, kwargs.pop("name", None))
        cache_dir = kwargs.pop("cache_dir", None)
        self._open_named(given, cache_dir, frameskip=frameskip, num_steps=num_steps, transform=transform, **kwargs)


class LanceVideoDataset(LanceDataset):
    """A Lance table with images in separate video files.

    `video_keys`, `decoder_cache_size` and `blob_buffer_size` have no effect: columns are found, and the engine manages its
    decoders. The other arguments are those of `LanceDataset`.
    """

    format = "lance-video"

    def __init__(
        self,
        path: Any = None,
        table_name: str | None = None,
        *,
        video_keys: Sequence[str] | None = None,
        decoder_cache_size: int = 16,
        blob_buffer_size: int = 4 << 20,
        **kwargs: Any,
    ) -> None:
        super().__init__(path, table_name, **kwargs)


class LeRobotAdapter(_Named):
    """A LeRobot dataset on this machine.

    Args:
        repo_id: A path, a name, or `lerobot://OWNER/NAME`.
        root: The folder of the dataset.
        episodes: Must be `None`: all episodes are read.
        frameskip, num_steps, transform, keys_to_load, keys_to_cache: As for `StoredDataset`.
        primary_camera_key, key_aliases: Must be `None`: columns keep the names that `swm inspect` lists.
        **lerobot_kwargs: Further arguments of `StoredDataset`.
    """

    format = "lerobot"

    def __init__(
        self,
        repo_id: Any = None,
        root: Any = None,
        episodes: Any = None,
        frameskip: int = 1,
        num_steps: int = 1,
        transform: Transform | None = None,
        keys_to_load: Sequence[str] | None = None,
        keys_to_cache: Sequence[str] | None = None,
        primary_camera_key: str | None = None,
        key_aliases: Mapping[str, str] | None = None,
        **lerobot_kwargs: Any,
    ) -> None:
        for name, value in (("episodes", episodes), ("primary_camera_key", primary_camera_key), ("key_aliases", key_aliases)):
            if value is not None:
                raise ValueError(f"LeRobotAdapter: {name} is not supported; leave it out")
        settings = dict(lerobot_kwargs)
        settings |= {"keys_to_load": keys_to_load, "keys_to_cache": keys_to_cache}
        given = (root, settings.pop("path", None), settings.pop("uri", None), settings.pop("name", None), repo_id)
        names = [None if name is None else str(name).removeprefix("lerobot://") for name in given]
        cache_dir = settings.pop("cache_dir", None)
        self._open_named(names, cache_dir, frameskip=frameskip, num_steps=num_steps, transform=transform, **settings)


def _table(path: Any, table_name: str | None) -> Any:
    """The path of a table, given by itself or by its folder and its name."""
    return path if table_name is None else f"{str(path).rstrip('/')}/{table_name}.lance"


def _no_credentials(connect_kwargs: Any) -> None:
    if connect_kwargs:
        raise ValueError("connect_kwargs: not supported; credentials of object stores come from the environment")


class LanceWriter(EpisodeWriter):
    """Writes a Lance table.

    Args:
        path: The path, or the folder of the table `table_name`.
        table_name: The name of the table, without its suffix.
        jpeg_quality: The quality of JPEG; images are lossless for `None`.
        connect_kwargs: Must be empty: credentials of object stores come from the environment.
        mode: As for `EpisodeWriter`.
        **kwargs: Further arguments of `EpisodeWriter`.
    """

    format = "lance"

    def __init__(
        self,
        path: Any,
        table_name: str | None = None,
        *,
        jpeg_quality: int | None = None,
        connect_kwargs: Any = None,
        mode: str = "append",
        **kwargs: Any,
    ) -> None:
        _no_credentials(connect_kwargs)
        super().__init__(_table(path, table_name), jpeg_quality=jpeg_quality, mode=mode, **kwargs)


class LanceVideoWriter(EpisodeWriter):
    """Writes a Lance table with images in separate video files.

    Args:
        path, table_name, connect_kwargs, mode: As for `LanceWriter`.
        fps: Has no effect: frames have no time.
        codec: `"libx264"`, which has no effect, or the codec of images that decides the quality, as for `EpisodeWriter`.
        **kwargs: Further arguments of `EpisodeWriter`.
    """

    format = "lance-video"

    def __init__(
        self,
        path: Any,
        table_name: str | None = None,
        *,
        fps: int = 25,
        codec: str | None = None,
        connect_kwargs: Any = None,
        mode: str = "append",
        **kwargs: Any,
    ) -> None:
        _no_credentials(connect_kwargs)
        codec = None if codec == "libx264" else codec
        super().__init__(_table(path, table_name), codec=codec, mode=mode, **kwargs)


class HDF5Writer(EpisodeWriter):
    """Writes an HDF5 file."""

    format = "hdf5"


class VideoWriter(EpisodeWriter):
    """Writes a folder of numeric columns and videos.

    Args:
        path, mode: As for `EpisodeWriter`.
        fps: Has no effect: frames have no time.
        codec: `"libx264"`, which has no effect, or the codec of images that decides the quality, as for `EpisodeWriter`.
        **kwargs: Further arguments of `EpisodeWriter`.
    """

    format = "video"

    def __init__(self, path: Any, fps: int = 25, codec: str | None = "libx264", *, mode: str = "append", **kwargs: Any) -> None:
        super().__init__(path, codec=None if codec == "libx264" else codec, mode=mode, **kwargs)


class FolderWriter(EpisodeWriter):
    """Writes a folder of numeric columns and image files."""

    format = "folder"
