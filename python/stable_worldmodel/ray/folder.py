"""The folder of a run: its request, and a record of each cell that is done. It is the only state of a run.

A folder is a path on a disk that all nodes share, or a URI of an object store.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import tempfile
import threading
import uuid
from pathlib import Path, PurePosixPath
from typing import Any

from .. import _engine

__all__ = ["Folder", "Outputs", "TrainingState"]

#: The files and folders of a training's folder.
_TRAINING_NAMES = re.compile(
    r"config\.json|manifest\.json|checkpoint|best|world|run\.json|train\.jsonl|failed-batch\.safetensors|events\.[\w.-]+|played-\d+"
)


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
            path = target / inside(name) if name else target
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)

    def is_empty(self) -> bool:
        """Whether there are no files below this location."""
        if "://" not in self.root:
            return not os.path.lexists(self.root) or (os.path.isdir(self.root) and not os.listdir(self.root))
        return not self.list()


def inside(name: str) -> str:
    """A path that stays in the folder it is relative to.

    Raises:
        RuntimeError: If it does not.
    """
    parts = name.split("/") if isinstance(name, str) else [""]
    if any(part in ("", ".", "..") or "\\" in part or "\0" in part for part in parts):
        raise RuntimeError(f"the folder of the run names the file {name!r}, which is outside of a folder")
    return name


class Outputs:
    """Stores what a cell wrote, and replaces nothing but files of its run.

    Before a cell writes its outputs, it stores their hashes in the folder of the run. A later attempt may replace these files.

    Args:
        records: The folder of the run.
        cell: The id of the cell.
        study: The title of a study whose files the cell may replace as well.
    """

    def __init__(self, records: Folder, cell: str, study: str | None = None) -> None:
        self.records, self.folder, self.study = records, f"written/{cell}", study

    def upload(self, source: Path, target: Folder) -> None:
        """Copies a file, or all files of a folder, from this machine.

        Raises:
            RuntimeError: If it would replace a file that this run did not write.
        """
        files = {"": source} if source.is_file() else {}
        files |= {path.relative_to(source).as_posix(): path for path in sorted(source.rglob("*")) if path.is_file()}
        if not files:
            raise RuntimeError(f"the command wrote no {source.name}")
        hashes = {target.at(name): _hash(path.read_bytes()) for name, path in files.items()}
        self.records.write_json(f"{self.folder}/{uuid.uuid4().hex}.json", hashes)
        for name, path in files.items():
            content = path.read_bytes()
            if target.write_new(name, content):
                continue
            existing = target.read(name)
            if existing == content:
                continue
            if existing is None or not self._is_own(target.at(name), existing):
                raise RuntimeError(
                    f"{target.at(name)} exists and was not written by this run: move it away, and give the same command again"
                )
            target.write(name, content)

    def _is_own(self, location: str, content: bytes) -> bool:
        """Whether this cell may replace a file with this content."""
        written = [self.records.read_json(f"{self.folder}/{name}") for name in self.records.list(self.folder)]
        return any(hashes.get(location) == _hash(content) for hashes in written) or self._is_of_study(location, content)

    def _is_of_study(self, location: str, content: bytes) -> bool:
        if self.study is None:
            return False
        if PurePosixPath(location).name != "study.json":
            return True  # it lies beside the `study.json` that was recognised before
        try:
            found = json.loads(content)
        except ValueError:
            return False
        return isinstance(found, dict) and found.get("title") == self.study and isinstance(found.get("cells"), list)


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


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
        """Brings the last complete checkpoint; returns whether there is one.

        Raises:
            RuntimeError: If `latest.json` names a file that no training has.
        """
        latest = self.folder.read_json("latest.json")
        if latest is None:
            return False
        if not isinstance(latest, dict) or latest.get("place") not in (0, 1) or not isinstance(latest.get("files"), list):
            raise RuntimeError(f"{self.folder.at('latest.json')} is damaged; remove it and run the command again")
        for name in latest["files"]:
            if not _TRAINING_NAMES.fullmatch(inside(name).split("/")[0]):
                raise RuntimeError(f"{self.folder.at('latest.json')} names {name!r}, which is no file of a training")
        place = Folder(self.folder.at(str(int(latest["place"]))))
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
            found_names = (path.relative_to(copy).as_posix() for path in Path(copy).rglob("*") if path.is_file())
            names = sorted(name for name in found_names if _TRAINING_NAMES.fullmatch(name.split("/")[0]))
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
