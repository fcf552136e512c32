"""Finds checkpoints on this machine, by path or name, without torch."""

from __future__ import annotations

import os
from pathlib import Path

from .. import _engine

__all__ = ["check_name", "folder_of", "home_of", "is_module", "is_stored", "located"]


def home_of(cache_dir: str | os.PathLike[str] | None) -> Path:
    """The folder in which `checkpoints/` has the checkpoints with a name: `cache_dir`, or `$STABLEWM_HOME` for `None`."""
    return Path(_engine.home() if cache_dir is None else os.path.expanduser(cache_dir))


def check_name(what: str, name: str | os.PathLike[str]) -> Path:
    """The name or the local folder of a checkpoint to write.

    Raises:
        ValueError: If it is a URI, or its last part is no name, as in `.` or `..`.
    """
    path = Path(os.path.expanduser(name))
    if "://" in str(name) or path.name in ("", ".."):
        raise ValueError(f"{what}: expected a name or a local folder for the checkpoint, got {str(name)!r}")
    return path


def folder_of(path: Path) -> Path | None:
    """The folder with the weights of a checkpoint of the engine: a run's own, or `checkpoint` in it."""
    folders = (path / name for name in ("", *_engine.CHECKPOINT_FOLDERS))
    return next((folder for folder in folders if (folder / "weights.safetensors").is_file()), None)


def is_stored(path: Path) -> bool:
    """Whether a checkpoint of the engine is at a path: a run, the folder `checkpoint` in it, or a capsule."""
    return path.suffix == ".safetensors" if path.is_file() else folder_of(path) is not None


def is_module(path: Path) -> bool:
    """Whether a torch module of `save_pretrained` is at a path: a `.pt` file, or a folder with one and `config.json`."""
    if path.is_file():
        return path.suffix == ".pt"
    return (path / "config.json").is_file() and any(file.is_file() for file in path.glob("*.pt"))


def located(name: str, cache_dir: str | os.PathLike[str] | None = None) -> Path | None:
    """The file or folder of a checkpoint; `None` if nothing has this name.

    A path counts before a name under `$STABLEWM_HOME/checkpoints`, and a name under `cache_dir` before a path. Files and
    folders without a checkpoint count last, so that an error says what is missing.
    """
    if not name:
        return None
    home, here = home_of(cache_dir), Path(os.path.expanduser(name))
    named, pulled = (home / "checkpoints" / folder for folder in (name, f"models--{name.replace('/', '--')}"))
    candidates = (here, named, pulled) if cache_dir is None else (named, home / name, here, pulled)
    existing = [path for path in candidates if path.exists()]
    return next((path for path in existing if is_stored(path) or is_module(path)), existing[0] if existing else None)
