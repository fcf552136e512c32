"""The commands of `swm` as functions, for programs. They print, and end as the command does: an error raises `SystemExit`."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

from . import _engine, _files

__all__ = ["checkpoints", "convert", "datasets", "envs", "fovs", "inspect", "main", "merge", "preview"]


def _run(*arguments: Any) -> None:
    code = _engine.command(["swm", *(str(argument) for argument in arguments)])
    if code:
        raise SystemExit(code)


def envs() -> None:
    """Lists the environments."""
    _run("envs")


def fovs(env: str) -> None:
    """Lists the factors of variation of an environment."""
    _run("fovs", env)


def datasets() -> None:
    """Lists the datasets of the home folder."""
    _run("datasets")


def inspect(name: str) -> None:
    """Describes a dataset."""
    _run("inspect", name)


def checkpoints(filter: str | None = None) -> None:
    """Lists the checkpoints of the home folder; with a regular expression, the names in which it occurs."""
    if filter is None:
        _run("checkpoints")
        return
    pattern, folder = re.compile(filter), Path(_engine.home()) / "checkpoints"
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if pattern.search(path.name):
            print(path.name)


def convert(name: str, output: str | None = None, dest_format: str = "video", source_format: str | None = None) -> None:
    """Writes a dataset in another format; see `swm.data.convert`.

    Args:
        name: The dataset.
        output: The target; the dataset's path with the suffix `_FORMAT` for `None`.
        dest_format: The format to write.
        source_format: The format to read; detected for `None`.
    """
    from . import data
    from .data.utils import resolve

    target = f"{os.path.splitext(resolve(name))[0]}_{dest_format}" if output is None else output
    outcome = data.convert(name, target, source_format=source_format, dest_format=dest_format)
    print(f"{target}: {outcome['episodes']} episodes")


def merge(
    sources: list[str], output: str, dest_format: str | None = None, overwrite: bool = False, mode: str | None = None
) -> None:
    """Writes the episodes of several datasets into one; see `swm.data.merge`."""
    from . import data

    outcome = data.merge(sources, output, dest_format=dest_format, mode=mode or ("overwrite" if overwrite else "error"))
    print(f"{output}: {outcome['episodes']} episodes")


def preview(
    name: str,
    num: int = 4,
    episodes: list[int] | None = None,
    seed: int = 0,
    output: str | None = None,
    key: str | None = None,
    fps: int = 15,
    open_dir: bool = False,
) -> None:
    """Writes videos of episodes.

    Args:
        name: The dataset.
        num: The number of episodes, which are chosen by the seed.
        episodes: The episodes, instead.
        seed: Chooses the episodes.
        output: The folder of the videos; `NAME_preview` for `None`.
        key: The column of images; the first one for `None`.
        fps: Frames per second.
        open_dir: Ignored: no window is opened.
    """
    import numpy as np

    from . import data
    from .utils import record_video_from_dataset

    folder = _files.local("output", f"{os.path.splitext(os.path.basename(name))[0]}_preview" if output is None else output)
    dataset = data.load_dataset(name)
    images = [column for column, (_, shape) in dataset.schema.items() if len(shape) == 3 and shape[-1] in (1, 3)]
    if key is None and not images:
        raise ValueError(f"{name} has no images; its columns are {dataset.column_names}")
    if episodes is None:
        chosen = np.random.default_rng(seed).permutation(dataset.num_episodes)[:num]
        episodes = sorted(int(episode) for episode in chosen)
    record_video_from_dataset(folder, dataset, episodes, max_steps=10**9, fps=fps, viewname=key or images[0])
    print(folder)


def main(version: bool | None = None) -> None:
    """The command line, with the arguments of this process; with `version`, prints the version."""
    if version:
        print(_engine.__version__)
        return
    from .__main__ import main as command

    command()
