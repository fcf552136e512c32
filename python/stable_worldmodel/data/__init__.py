"""Datasets: reading, loading, writing, converting and examining episodes.

- `load_dataset` opens a dataset of any format for a torch `DataLoader`; `Loader` yields shuffled batches directly.
- `open_writer` stores episodes; `convert`, `doctor` and `inspect` convert, examine and describe datasets; `export` writes
  episodes for the viewer of Rerun.
- `register_format` adds a user-defined format to these functions.
- `MergeDataset`, `ConcatDataset`, `GoalDataset`, `ReplayBuffer`: datasets derived from other datasets or a collection.
"""

from .buffer import ReplayBuffer, classic_filter
from .dataset import ConcatDataset, Dataset, GoalDataset, MergeDataset, StoredDataset
from .format import (
    EPISODE_DATA_KEY,
    FORMATS,
    WRITE_MODES,
    Format,
    Writer,
    detect_format,
    get_format,
    list_formats,
    open_writer,
    register_format,
    split_episode_data,
    validate_write_mode,
)
from .formats import (
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
from .loader import Goals, Loader
from .normalization import (
    ColumnTransform,
    IdentityScaler,
    PercentileScaler,
    ZScoreScaler,
    column_normalizer,
    get_scaler,
)
from .utils import convert, doctor, ensure_dir_exists, export, get_cache_dir, inspect, load_dataset, merge
from .writer import EpisodeWriter

__all__ = [
    "EPISODE_DATA_KEY",
    "FORMATS",
    "WRITE_MODES",
    "ColumnTransform",
    "ConcatDataset",
    "Dataset",
    "EpisodeWriter",
    "FolderDataset",
    "FolderWriter",
    "Format",
    "GoalDataset",
    "Goals",
    "HDF5Dataset",
    "HDF5Writer",
    "IdentityScaler",
    "ImageDataset",
    "LanceDataset",
    "LanceVideoDataset",
    "LanceVideoWriter",
    "LanceWriter",
    "LeRobotAdapter",
    "Loader",
    "MergeDataset",
    "PercentileScaler",
    "ReplayBuffer",
    "StoredDataset",
    "VideoDataset",
    "VideoWriter",
    "Writer",
    "ZScoreScaler",
    "classic_filter",
    "column_normalizer",
    "convert",
    "detect_format",
    "doctor",
    "ensure_dir_exists",
    "export",
    "get_cache_dir",
    "get_format",
    "get_scaler",
    "inspect",
    "list_formats",
    "load_dataset",
    "merge",
    "open_writer",
    "register_format",
    "split_episode_data",
    "validate_write_mode",
]
