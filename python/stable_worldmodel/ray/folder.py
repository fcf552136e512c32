"""The folder of a run: its request, and a record of each cell that is done. It is the only state of a run.

A folder is a path on a disk that all nodes share, or a URI of an object store.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import threading
from pathlib import Path
from typing import Any

from .. import _engine

__all__ = ["Folder", "TrainingState"]


class Folder:
    """A folder, or one file, on a shared disk or in an object store.

    Args:
        root: The path or the URI.
    """

    def __init__(self, root: str) -> None:
        self.root = root.rstrip("/")

    def at(self, name: str) -> str:
        """The location of a file."""
        return f"{self.root}/{name}" if name else self.root

    def read(self, name: str) -> bytes | None:
        """The content of a file, or `None` if it does not exist."""
        return _engine.object_read(self.at(name))

    def read_json(self, name: str) -> Any:
        """The value of a JSON file, or `None` if it does not exist."""
        content = self.read(name)
        if content is None:
            return None
        try:
            return json.loads(content)
        except ValueError as error:
            raise RuntimeError(f"{self.at(name)} is damaged ({error}); remove it and run the command again") from None

    def write(self, name: str, content: bytes) -> None:
        """Writes a file."""
        _engine.object_write(self.at(name), content)

    def write_json(self, name: str, value: Any) -> None:
        """Writes a value as a JSON file."""
        self.write(name, (json.dumps(value, indent=2) + "\n").encode())

    def write_new(self, name: str, content: bytes) -> bool:
        """Writes a file unless it exists; returns whether it did."""
        return _engine.object_write_new(self.at(name), content)

    def list(self, folder: str = "") -> list[str]:
        """The paths of all files below a folder, relative to it."""
        return _engine.object_list(self.at(folder))

    def download(self, target: Path, missing_ok: bool = False) -> None:
        """Copies all files below this location, or the file at it, to a path on this machine."""
        for name in self.list() or [""]:
            content = self.read(name)
            if content is None:
                if missing_ok:
                    continue
                raise RuntimeError(f"{self.at(name)} does not exist")
            path = target / name if name else target
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)

    def upload(self, source: Path) -> None:
        """Copies a file, or all files of a folder, from this machine."""
        if source.is_file():
            self.write("", source.read_bytes())
            return
        files = [path for path in sorted(source.rglob("*")) if path.is_file()]
        if not files:
            raise RuntimeError(f"the command wrote no {source.name}")
        for path in files:
            self.write(path.relative_to(source).as_posix(), path.read_bytes())


class TrainingState:
    """The checkpoints of a training in the folder of the run.

    They alternate between two places, and `latest.json` names the complete one, so a kill during a copy loses nothing but time.

    Args:
        location: Where they are stored.
        local: The folder of the training on this node.
    """

    def __init__(self, location: str, local: Path) -> None:
        self.folder, self.local = Folder(location), local
        self._stored: tuple[int, int] | None = None

    def restore(self) -> bool:
        """Brings the last complete checkpoint; returns whether there is one."""
        latest = self.folder.read_json("latest.json")
        if latest is None:
            return False
        place = Folder(self.folder.at(str(latest["place"])))
        for name in latest["files"]:
            Folder(place.at(name)).download(self.local / name)
        return True

    def watch(self, stop: threading.Event, seconds: float) -> None:
        """Stores every new checkpoint until it is told to stop."""
        while not stop.wait(seconds):
            try:
                self.store()
            except Exception as error:  # the training goes on, and its last state is stored at its end
                print(f"warning: a checkpoint was not stored: {error}", flush=True)

    def store(self) -> bool:
        """Stores the checkpoint if it is a new one; returns whether it did."""
        found = self._identity()
        if found is None or found == self._stored:
            return False
        with tempfile.TemporaryDirectory(prefix="swm-state-", dir=self.local.parent) as copy:
            shutil.copytree(self.local, copy, dirs_exist_ok=True, copy_function=_link)
            if self._identity() != found:
                return False  # the training replaced it meanwhile
            latest = self.folder.read_json("latest.json")
            place = 1 - int(latest["place"]) if latest else 0
            names = sorted(path.relative_to(copy).as_posix() for path in Path(copy).rglob("*") if path.is_file())
            for name in names:
                self.folder.write(f"{place}/{name}", (Path(copy) / name).read_bytes())
            self.folder.write_json("latest.json", {"place": place, "files": names})
        self._stored = found
        return True

    def _identity(self) -> tuple[int, int] | None:
        """What changes when a training replaces its checkpoint: it writes a new folder and renames it."""
        try:
            status = os.stat(self.local / "checkpoint")
        except OSError:
            return None
        return status.st_ino, status.st_mtime_ns


def _link(source: str, target: str) -> None:
    """Copies a file that grows; others are replaced as a whole, so a second name of theirs is a copy."""
    if source.endswith(".jsonl") or "events" in os.path.basename(source):
        shutil.copyfile(source, target)
    else:
        os.link(source, target)
