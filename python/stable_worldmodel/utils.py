"""The home folder, descriptions of environments and visual wrappers, and small functions for programs."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from . import _engine, _files, _options

__all__ = [
    "DEFAULT_CACHE_DIR",
    "HF_BASE_URL",
    "default",
    "describe",
    "exists",
    "flatten_dict",
    "get_in",
    "home",
    "pretraining",
    "record_video_from_dataset",
    "wrappers",
]

#: The home folder, unless `$STABLEWM_HOME` names another one.
DEFAULT_CACHE_DIR = str(Path("~/.stable_worldmodel").expanduser())
#: The address of the Hugging Face hub.
HF_BASE_URL = "https://huggingface.co"


def home() -> str:
    """The home folder of datasets and checkpoints given by name: `$STABLEWM_HOME`, or `~/.stable_worldmodel`."""
    return _engine.home()


def describe(env: str) -> dict[str, Any]:
    """The description of an environment: spaces, info columns, factors of variation, options, experts."""
    return dict(json.loads(_engine.spec(env)))


def wrappers() -> dict[str, Any]:
    """The settings of every visual wrapper, by its id."""
    return dict(json.loads(_engine.wrappers()))


def exists(val: Any) -> bool:
    """Whether a value is not `None`."""
    return val is not None


def default(val: Any, d: Any) -> Any:
    """The value `val`, or `d` if it is `None`."""
    return d if val is None else val


def flatten_dict(d: Mapping[str, Any], parent_key: str = "", sep: str = ".") -> dict[str, Any]:
    """A nested dict as one dict, whose keys join the keys of the levels by `sep`, after `parent_key`."""
    flat: dict[str, Any] = {}
    for key, value in d.items():
        name = f"{parent_key}{sep}{key}" if parent_key else key
        flat.update(flatten_dict(value, name, sep) if isinstance(value, Mapping) else {name: value})
    return flat


def get_in(mapping: Any, path: Iterable[Any]) -> Any:
    """The value of nested mappings at a path of keys."""
    for key in path:
        mapping = mapping[key]
    return mapping


def pretraining(script_path: str, dataset_name: str, output_model_name: str, dump_object: bool = True, args: str = "") -> None:
    """Runs a training script in a process of this interpreter, with Hydra overrides.

    The script gets `args`, and the overrides `++dump_object`, `dataset_name` and `output_model_name`. To train a model of
    the engine, use `swm.wm.train`.

    Raises:
        ValueError: If there is no such script.
        SystemExit: If the script fails, with its code.
    """
    if not Path(script_path).is_file():
        raise ValueError(f"script_path: there is no file {script_path!r}")
    overrides = [f"++dump_object={dump_object}", f"dataset_name={dataset_name}", f"output_model_name={output_model_name}"]
    command = [sys.executable, str(script_path), *shlex.split(args), *overrides]
    code = subprocess.run(command, env={"PYTHONUNBUFFERED": "1", **os.environ}).returncode
    if code:
        sys.exit(code)


def record_video_from_dataset(
    video_path: str | os.PathLike[str],
    dataset: Any,
    episode_idx: int | Sequence[int],
    max_steps: int = 500,
    fps: int = 30,
    viewname: str | Sequence[str] = "pixels",
) -> None:
    """Writes a video `episode_INDEX.mp4` of each episode.

    Args:
        video_path: The folder of the videos; it is created if it does not exist.
        dataset: A dataset with images.
        episode_idx: The episode, or the episodes.
        max_steps: The largest number of frames.
        fps: Frames per second.
        viewname: The column of images, or several columns, which a frame shows beside each other.

    Raises:
        ValueError: If the folder is a URI, or the dataset does not have a column.
        IndexError: If the dataset does not have an episode.
    """
    import numpy as np

    from .data._tensors import to_numpy
    from .plot import save_video

    folder = _files.local("video_path", video_path)
    views = [viewname] if isinstance(viewname, str) else list(viewname)
    missing = [view for view in views if view not in dataset.column_names]
    if missing:
        raise ValueError(f"viewname: the dataset has no {missing}; its columns are {list(dataset.column_names)}")
    total = len(dataset.lengths)
    for given in episode_idx if isinstance(episode_idx, Iterable) else [episode_idx]:
        episode = _options.whole("episode_idx", given)
        if not -total <= episode < total:
            raise IndexError(f"episode_idx: {episode}; the dataset has {total} episodes")
        episode %= total
        columns = dataset.load_episode(episode)
        parts = [np.moveaxis(to_numpy(columns[view])[:max_steps], 1, -1) for view in views]
        frames = list(np.concatenate(parts, axis=2))
        save_video(folder / f"episode_{episode}.mp4", frames, fps)
