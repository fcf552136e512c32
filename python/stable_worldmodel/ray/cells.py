"""The cells of each kind of run: arguments of `swm`.

A run has stages. The cells of a stage run in any order and on any node; a stage begins when all cells of the one before are
done. The last stage joins what the cells wrote, on a node, so that nothing large passes through the driver.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from typing import Any

from .folder import Folder
from .worker import SCRATCH, Cell

__all__ = ["count", "stages"]

#: The files of a study besides those of its cells. A study without frames has no image distances.
_STUDY_FILES = ("study/study.json", "study/image-distances.json?")


#: The names of the cells of studies and trainings, which name files.
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.,=+-]*")


def stages(request: dict[str, Any]) -> Iterator[Iterable[Cell]]:
    """The stages of a run.

    Raises:
        ValueError: If the request has a cell whose name would leave the folder of the run or its output.
    """
    kinds = {"collect": _ranges, "convert": _ranges, "eval": _eval, "study": _study, "train": _train}
    kind, cells = request["kind"], request["cells"]
    names = cells["ids"] if kind == "study" else [run["name"] for run in cells["runs"]] if kind == "train" else []
    for name in names:
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            raise ValueError(f"the request names a cell {name!r}, which is no name of a file")
    return kinds[kind](request)


def count(request: dict[str, Any]) -> int:
    """The number of cells."""
    kind, cells = request["kind"], request["cells"]
    if kind == "train":
        return len(cells["runs"])
    if kind in ("collect", "convert"):
        return int(cells["shards"]) + 1 + bool(cells.get("verify"))
    return len(cells["conditions"] if kind == "eval" else cells["ids"]) + 1


def _ranges(request: dict[str, Any]) -> Iterator[Iterable[Cell]]:
    """Shards of a dataset, and their commit; after a conversion, its comparison with the source."""
    shards, output, arguments = int(request["cells"]["shards"]), request["output"], request["arguments"]
    collects = request["kind"] == "collect"
    own = [*arguments, "--output", output, "--resume"] if collects else arguments
    yield (
        {
            "id": f"{index:06d}",
            "name": f"shard {index} of {shards}",
            "arguments": [*own, "--shard", f"{index}/{shards}"],
        }
        for index in range(shards)
    )
    yield [
        {
            "id": "commit",
            "name": "commit of the shards",
            "arguments": ["datasets", "commit", output],
            # A commit that was killed before its record left no shards to commit.
            "done_if": (["inspect", output], {"episodes": request["cells"]["episodes"]}),
        }
    ]
    if request["cells"].get("verify"):
        yield [{"id": "verify", "name": "comparison with the source", "arguments": arguments}]


def _eval(request: dict[str, Any]) -> Iterator[Iterable[Cell]]:
    """Conditions of an evaluation, and their results in one file."""
    parts = Folder(request["folder"]).at("parts")
    yield (
        {
            "id": f"{index:06d}",
            "name": f"condition '{name}'",
            "arguments": [*request["arguments"], "--part", str(index), "--output", f"{SCRATCH}/out"],
            "outputs": {"out/results.json": f"{parts}/{index:06d}.json"},
        }
        for index, name in enumerate(request["cells"]["conditions"])
    )
    yield [
        {
            "id": "join",
            "name": "results of all conditions",
            "arguments": [*request["arguments"], "--join", f"{SCRATCH}/parts", "--output", f"{SCRATCH}/out"],
            "inputs": {"parts": parts},
            "outputs": {"out": request["output"]},
        }
    ]


def _study(request: dict[str, Any]) -> Iterator[Iterable[Cell]]:
    """Cells of a study, and its image distances and results."""
    study, ids = request["cells"]["study"], request["cells"]["ids"]
    output = Folder(request["output"])
    yield (
        {
            "id": identity,
            "name": f"{cell['request']['conditions'][0]['name']}, {cell['request']['policies'][0]['name']} ({identity})",
            "arguments": ["study", "resume", f"{SCRATCH}/study", "--trust", "--cell", identity],
            "files": {"study/study.json": json.dumps(study | {"cells": [cell], "published": []})},
            # What another run evaluated, perhaps on one machine, is not evaluated again.
            "inputs": {f"study/cells/{identity}.json?": output.at(f"cells/{identity}.json")},
            "outputs": {f"study/cells/{identity}.json": output.at(f"cells/{identity}.json")},
        }
        for identity, cell in zip(ids, study["cells"], strict=True)
    )
    yield [
        {
            "id": "join",
            "name": "image distances of the study",
            "arguments": ["study", "resume", f"{SCRATCH}/study", "--trust"],
            "files": {"study/study.json": json.dumps(study)},
            "inputs": {"study/cells": output.at("cells")},
            "outputs": {name: output.at(name.removeprefix("study/").rstrip("?")) for name in _STUDY_FILES},
            "study": study["title"],
        }
    ]


def _train(request: dict[str, Any]) -> Iterator[Iterable[Cell]]:
    """Training runs, each continued from its last checkpoint in the folder of the run."""
    folder, output = Folder(request["folder"]), Folder(request["output"])
    yield (
        {
            "id": run["name"],
            "name": f"training {run['name']}",
            "arguments": [*request["arguments"], *run["settings"], "--output", f"{SCRATCH}/run"],
            "state": folder.at(f"state/{run['name']}"),
            "outputs": {"run": output.at(run["name"])},
        }
        for run in request["cells"]["runs"]
    )
