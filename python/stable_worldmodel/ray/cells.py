"""The cells of each kind of run: arguments of `swm`.

A run has stages. The cells of a stage run in any order and on any node; a stage begins when all cells of the one before are
done. The last stage joins what the cells wrote, on a node, so that nothing large passes through the driver.
"""

from __future__ import annotations

import json
import re
from collections.abc import Generator, Iterable, Iterator
from typing import Any

from .folder import Folder
from .worker import SCRATCH, Cell

__all__ = ["count", "stages"]

#: The files of a study besides those of its cells. A study without frames has no image distances.
_STUDY_FILES = ("study/study.json", "study/image-distances.json?")

#: The file with the study of all levels of a breaking point, in the folder of the run.
_LEVELS = "parts/levels.json"

#: The names of the cells of studies and trainings, which name files.
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.,=+-]*")


def stages(request: dict[str, Any]) -> Iterator[Iterable[Cell]]:
    """The stages of a run.

    Raises:
        ValueError: If the request has a cell whose name would leave the folder of the run or its output.
    """
    kinds = {"collect": _ranges, "convert": _ranges, "eval": _eval, "study": _study, "train": _train}
    kind, cells = request["kind"], request["cells"]
    names = [*cells["ids"], cells.get("model", "none")] if kind == "study" else []
    names += [run["name"] for run in cells["runs"]] if kind == "train" else []
    for name in names:
        if not _is_name(name):
            raise ValueError(f"the request names a cell {name!r}, which is no name of a file")
    return kinds[kind](request)


def _is_name(name: Any) -> bool:
    return isinstance(name, str) and _NAME.fullmatch(name) is not None


def count(request: dict[str, Any]) -> int:
    """The number of cells; the largest number, if the results of an evaluation or a study decide it."""
    kind, cells = request["kind"], request["cells"]
    if kind == "train":
        return len(cells["runs"])
    if kind in ("collect", "convert"):
        return int(cells["shards"]) + 1 + bool(cells.get("verify"))
    if "together" in cells:
        return 1
    parts = len(cells["conditions"] if kind == "eval" else cells["ids"])
    each = len(cells.get("stages", ()))
    work = each * (parts + 1) if each else parts
    if "inside" in cells:
        inside = int(cells["inside"])
        work += 1 + (each * (parts + inside + 1) if each else inside)
    return work + 1


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
    """Conditions of an evaluation, and their results in one file; with `--until`, stages that a cell ends."""
    parts, cells = Folder(request["folder"]).at("parts"), request["cells"]
    if "stages" not in cells:
        yield (_part(request, index, name, f"{index:06d}", "results") for index, name in enumerate(cells["conditions"]))
        yield [_join(request, {"parts": parts})]
        return
    before = None
    for episodes in cells["stages"]:
        yield _stage(request, int(episodes), before)
        here = f"stages/{int(episodes):06d}"
        decision = {"id": f"stage-{int(episodes):06d}", "name": f"the rule after {episodes} episodes"}
        joined = _join(request, {"parts/results": f"{parts}/{here}"}, "--stage", str(episodes))
        yield [{**joined, **decision, "outputs": {}}]
        before = here
        if _ends(request, decision["id"]):
            break
    yield [_join(request, {"parts/results": f"{parts}/{before}", "parts/videos?": f"{parts}/videos"}, "--stage", str(episodes))]


def _part(request: dict[str, Any], index: int, name: str, identity: str, results: str) -> Cell:
    """A condition of an evaluation."""
    parts = Folder(request["folder"]).at("parts")
    return {
        "id": identity,
        "name": f"condition '{name}'",
        "arguments": [*request["arguments"], "--part", str(index), "--output", f"{SCRATCH}/out"],
        "outputs": {
            "out/results.json": f"{parts}/{results}/{index:06d}.json",
            "out/traces.json?": f"{parts}/traces/{index:06d}.json",
            "out/videos?": f"{parts}/videos/{index:06d}",
        },
    }


def _stage(request: dict[str, Any], episodes: int, before: str | None) -> Iterator[Cell]:
    """The conditions of a stage of an evaluation, which continue the results of the stage before."""
    parts = Folder(request["folder"]).at("parts")
    for index, name in enumerate(request["cells"]["conditions"]):
        cell = _part(request, index, name, f"stage-{episodes:06d}-{index:06d}", f"stages/{episodes:06d}")
        cell["name"] += f", {episodes} episodes"
        cell["arguments"] += ["--stage", str(episodes)]
        if before is not None:
            cell["arguments"] += ["--after", f"{SCRATCH}/before.json"]
            cell["inputs"] = {"before.json": f"{parts}/{before}/{index:06d}.json"}
        yield cell


def _join(request: dict[str, Any], inputs: dict[str, str], *more: str) -> Cell:
    """The results of all conditions in one file, with their videos and traces."""
    return {
        "id": "join",
        "name": "results of all conditions",
        "arguments": [*request["arguments"], "--join", f"{SCRATCH}/parts", *more, "--output", f"{SCRATCH}/out"],
        "inputs": inputs,
        "outputs": {"out": request["output"]},
    }


def _ends(request: dict[str, Any], cell: str) -> bool:
    """Whether a cell found that the results meet the rule of `--until`, or that there are no more episodes."""
    record = Folder(request["folder"]).read_json(f"cells/{cell}.json")
    outcome = record.get("outcome") if isinstance(record, dict) else None
    if not isinstance(outcome, dict) or not isinstance(outcome.get("ends"), bool):
        raise RuntimeError(f"the record of the cell {cell} is damaged; remove it and run the command again")
    return bool(outcome["ends"])


def _study(request: dict[str, Any]) -> Iterator[Iterable[Cell]]:
    """Cells of a study, each an evaluation or a row of a table, and its file and its image distances."""
    cells, output = request["cells"], Folder(request["output"])
    if "inside" in cells:
        yield from _break(request)
    elif "stages" in cells:
        at = yield from _study_stages(request)
        yield [_whole(request, at, ("study/cells", *_STUDY_FILES))]
    elif "together" in cells:
        # No row may have been measured.
        yield [_whole(request, {"study/cells?": output.at("cells")}, ("study/cells?", *_STUDY_FILES))]
    else:
        rows = (_row(request, *pair) for pair in zip(cells["ids"], cells["study"]["cells"], strict=True))
        if "model" in cells:
            # The first row trains the model, which the others find in the output.
            first, (local, stored) = next(rows), _model(request)
            training = {"state": Folder(request["folder"]).at(f"state/{cells['model']}"), "trains": local}
            outputs = {f"{local}?": stored, **first["outputs"]}
            yield [first | training | {"outputs": outputs, "study": cells["study"]["title"]}]
        yield rows
        found = f"study/cells{'?' * ('kind' in cells['study'])}"
        yield [_whole(request, {found: output.at("cells")}, _STUDY_FILES)]


def _row(request: dict[str, Any], identity: str, cell: dict[str, Any]) -> Cell:
    """An evaluation of a study, or a row of a table."""
    study, output = request["cells"]["study"], Folder(request["output"])
    is_table, file = "kind" in study, f"study/cells/{identity}.json"
    model, stored = _model(request)
    return {
        "id": identity,
        "name": f"{_described(cell)} ({identity})",
        "arguments": ["study", "resume", f"{SCRATCH}/study", "--trust", *([] if is_table else ["--cell", identity])],
        "files": {"study/study.json": _alone(study, cell)},
        # What another run evaluated or trained, perhaps on one machine, is not evaluated again.
        "inputs": {f"{file}?": output.at(f"cells/{identity}.json"), **({f"{model}?": stored} if model else {})},
        # A row of a table stays empty on a node that cannot measure it.
        "outputs": {f"{file}{'?' * is_table}": output.at(f"cells/{identity}.json")},
    }


def _model(request: dict[str, Any]) -> tuple[str, str]:
    """The folder of the model that the rows of a table share, in the folder of a cell and in the output; empty without one."""
    name = request["cells"].get("model")
    return (f"study/models/{name}", Folder(request["output"]).at(f"models/{name}")) if name else ("", "")


def _break(request: dict[str, Any]) -> Iterator[Iterable[Cell]]:
    """Cells of the levels of a grid, a cell that chooses levels inside an interval, and their cells.

    The choice depends on results that are stored, so a driver that starts again chooses the same.
    """
    grid, folder, output = request["cells"], Folder(request["folder"]), Folder(request["output"])
    if "stages" in grid:
        at = yield from _study_stages(request)
    else:
        yield (_row(request, *pair) for pair in zip(grid["ids"], grid["study"]["cells"], strict=True))
        at = {f"study/cells/{identity}.json": output.at(f"cells/{identity}.json") for identity in grid["ids"]}
    yield [
        {
            "id": "levels",
            "name": "the levels inside an interval",
            "arguments": [*request["arguments"], "--inside", "--output", f"{SCRATCH}/study"],
            "files": {"study/study.json": json.dumps(grid["study"])},
            "inputs": at,
            "outputs": {"study/levels.json": folder.at(_LEVELS)},
        }
    ]
    whole = request | {"cells": _with_levels(grid, folder)}
    if "stages" in grid:
        at = yield from _study_stages(whole, "inside-", at)
        yield [_whole(whole, at, ("study/cells", *_STUDY_FILES))]
        return
    pairs = zip(whole["cells"]["ids"], whole["cells"]["study"]["cells"], strict=True)
    yield (_row(whole, *pair) for pair in pairs if pair[0] not in grid["ids"])
    yield [_whole(whole, {"study/cells": output.at("cells")}, _STUDY_FILES)]


def _with_levels(grid: dict[str, Any], folder: Folder) -> dict[str, Any]:
    """The study with the levels inside an interval, from the file that a cell wrote.

    Raises:
        RuntimeError: If it has other cells than those of the grid at other values of the factor.
    """
    found = folder.read_json(_LEVELS)
    fix = f"remove it and {folder.at('cells/levels.json')}, and run the command again"
    try:
        study, ids = found["study"], found["ids"]
        known = [_without_level(cell) for cell in grid["study"]["cells"]]
        fits = len(ids) == len(study["cells"]) and study | {"cells": []} == grid["study"] | {"cells": []}
        fits = fits and found.get("stages") == grid.get("stages") and all(map(_is_name, ids))
        fits = fits and all(_without_level(cell) in known for cell in study["cells"])
    except (KeyError, ValueError, TypeError, AttributeError):
        fits = False
    if not fits:
        raise RuntimeError(f"{folder.at(_LEVELS)} is damaged; {fix}")
    return dict(found)


def _without_level(cell: dict[str, Any]) -> dict[str, Any]:
    """A cell of a study without the value of its factor: its change, and the numbers that its condition pins."""
    request = cell["request"]
    (condition,) = request["conditions"]
    variation = condition["variation"]
    values = {
        key: None if isinstance(value, list) and all(isinstance(number, (int, float)) for number in value) else value
        for key, value in variation["variation_values"].items()
    }
    condition = condition | {"name": None, "variation": variation | {"variation_values": values}}
    variables = cell["variables"] | {"change": None}
    return cell | {"variables": variables, "request": request | {"conditions": [condition]}}


def _study_stages(
    request: dict[str, Any], prefix: str = "", before: dict[str, str] | None = None
) -> Generator[Iterable[Cell], None, dict[str, str]]:
    """Cells of a study that its results end: stages, after each of which a cell says which cells need more starts.

    Each cell of a stage continues the results of its stage before. They are kept apart, so that a node that comes back with an
    earlier stage replaces nothing.

    Args:
        request: The request.
        prefix: What the ids of the cells begin with.
        before: Where the results of some cells are.

    Returns:
        Where the results of all cells are.
    """
    study, ids = request["cells"]["study"], request["cells"]["ids"]
    output, folder = Folder(request["output"]), Folder(request["folder"])
    of = dict(zip(ids, study["cells"], strict=True))
    files = {identity: f"study/cells/{identity}.json" for identity in ids}
    # What another run evaluated, perhaps on one machine, is not evaluated again.
    at = {name: output.at(f"cells/{identity}.json") for identity, name in files.items()} | (before or {})
    still_open, sure = ids, set(before or {})
    for stage in map(int, request["cells"]["stages"]):
        here, decision = f"parts/{prefix}stages/{stage:06d}", f"{prefix}stage-{stage:06d}"
        yield (
            {
                "id": f"{decision}-{identity}",
                "name": f"{_described(of[identity])} ({identity}), {stage} episodes",
                "arguments": [
                    *("study", "resume", f"{SCRATCH}/study", "--trust", "--cell", identity, "--stage", str(stage)),
                ],
                "files": {"study/study.json": _alone(study, of[identity])},
                "inputs": {files[identity] + "?" * (files[identity] not in sure): at[files[identity]]},
                "outputs": {files[identity]: folder.at(f"{here}/{identity}.json")},
            }
            for identity in still_open
        )
        at |= {files[identity]: folder.at(f"{here}/{identity}.json") for identity in still_open}
        decided = _whole(request, at, {}, "--stage", str(stage))
        decided |= {"id": decision, "name": f"the rule after {stage} episodes"}
        opened = f"parts/{prefix}open/{stage:06d}.json"
        yield [decided | {"outputs": {"study/open.json": folder.at(opened)}}]
        still_open, sure = _open_after(folder, opened, decision, of), set(at)
        if not still_open:
            break
    return at


def _open_after(folder: Folder, name: str, decision: str, cells: dict[str, Any]) -> list[str]:
    """The ids of the cells that need more starts than those of a stage, from the file that a cell wrote."""
    found = folder.read_json(name)
    if not isinstance(found, list) or not all(isinstance(identity, str) and identity in cells for identity in found):
        fix = f"remove it and {folder.at(f'cells/{decision}.json')}, and run the command again"
        raise RuntimeError(f"{folder.at(name)} is damaged; {fix}")
    return found


def _alone(study: dict[str, Any], cell: dict[str, Any]) -> str:
    """The file of a study with one cell."""
    alone = study | {"cells": [cell]}
    if "kind" not in study:
        alone["published"] = []
    if study.get("until"):
        # A cell alone has no gap that a rule could decide. Its own results follow no rule.
        alone["until"] = "ci=5"
    return json.dumps(alone)


def _whole(request: dict[str, Any], inputs: dict[str, str], outputs: Iterable[str], *more: str) -> Cell:
    """The study with the results of all its cells."""
    study, output = request["cells"]["study"], Folder(request["output"])
    return {
        "id": "join",
        "name": "the study with all its cells",
        "arguments": ["study", "resume", f"{SCRATCH}/study", "--trust", *more],
        "files": {"study/study.json": json.dumps(study)},
        "inputs": inputs,
        "outputs": {name: output.at(name.removeprefix("study/").rstrip("?")) for name in outputs},
        "study": study["title"],
    }


def _described(cell: dict[str, Any]) -> str:
    """The name of a row; the condition and the policy of an evaluation."""
    request = cell["request"]
    return str(cell["name"]) if "name" in cell else f"{request['conditions'][0]['name']}, {request['policies'][0]['name']}"


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
