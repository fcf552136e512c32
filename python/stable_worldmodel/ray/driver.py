"""Runs the cells of a request as Ray tasks.

Ray places the cells, retries those that fail or whose node dies, and scales the cluster. This module knows which cells are
done: those with a record in the folder of the run.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterable
from typing import Any

import ray
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from . import worker
from .cells import count, stages
from .folder import Folder
from .supply import WAIT_SECONDS, RunRefused, Supply, task_options

__all__ = ["CellsFailed", "RunRefused", "begin", "execute", "read_request"]

#: Tasks that wait in Ray at a time: enough for its autoscaler to see the demand, and few enough for the driver's memory.
QUEUED = 2000
#: How often Ray runs a cell again that failed or whose node died.
RETRIES = 3
#: So many failed cells, and none that is done, end the run: its cause is not in the cells.
HOPELESS = 8
#: Seconds in which a node answers whether it may run cells.
PROBE_SECONDS = 300
#: Seconds between two lines of progress.
PROGRESS_SECONDS = 5.0

# Nodes without this package answer as well.
ray.cloudpickle.register_pickle_by_value(worker)


class CellsFailed(RuntimeError):
    """Some cells failed after all retries; the others are done and kept."""


def execute(request: dict[str, Any]) -> dict[str, Any]:
    """Runs the cells of a request that have no record, and returns a summary.

    Args:
        request: What `swm COMMAND --on ray` wrote.

    Raises:
        RunRefused: If the folder has another run, a node does not fit, or none has what a cell takes and none joins in time.
        CellsFailed: If cells failed after all retries.
    """
    folder, began = Folder(request["folder"]), time.monotonic()
    begin(folder, request)
    resources = task_options(request["resources"])
    supply = Supply(request["resources"], request.get("wait", WAIT_SECONDS))
    run = {key: request[key] for key in ("folder", "version", "directory")}
    run["threads"] = max(1, int(resources["num_cpus"]))
    run["level"] = _check_nodes(folder, run, resources)
    ran, finished = 0, {name.removesuffix(".json") for name in folder.list("cells")}
    progress = _Progress(count(request))
    for cells in stages(request):
        ran += _run_stage(cells, finished, run, resources, supply, progress)
    summary = {"output": request["output"], "folder": request["folder"], "cells": progress.done, "ran": ran}
    return summary | {"seconds": round(time.monotonic() - began, 3)}


def begin(folder: Folder, request: dict[str, Any]) -> None:
    """Writes the request, or checks that the folder has this one.

    Raises:
        RunRefused: If the folder has another run, or files and no run.
    """
    found = read_request(folder)
    if found is None:
        if not folder.is_empty():
            raise RunRefused(f"{folder.root} has files and no request.json: give another --run-folder, or move them away")
        if folder.write_new("request.json", (json.dumps(request) + "\n").encode()):
            return
        found = read_request(folder) or {}
    # Where a run is continued, and what its cells take, decide no result.
    free = ("resources", "wait", "directory", "folder")
    differing = [key for key in request if key not in free and found.get(key) != request[key]]
    if differing:
        raise RunRefused(
            f"{folder.root} has another run: its {differing[0]} is {_short(found.get(differing[0]))}, not "
            f"{_short(request[differing[0]])}; give the command that began it, or another --run-folder and output"
        )
    if found != request:
        folder.write_json("request.json", request)


def read_request(folder: Folder) -> dict[str, Any] | None:
    """The request in the folder of a run, if there is one.

    Raises:
        RunRefused: If it is damaged.
    """
    try:
        found = folder.read_json("request.json")
    except RuntimeError:
        found = False
    if found is not None and not isinstance(found, dict):
        raise RunRefused(f"{folder.at('request.json')} is damaged: give another --run-folder and output")
    return found


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 300 else f"{text[:300]}…"


def _check_nodes(folder: Folder, run: dict[str, Any], resources: dict[str, Any]) -> str | None:
    """Asks every node that can run a cell whether it fits, and returns the processor level that the run keeps."""
    able = [node for node in ray.nodes() if node["Alive"] and node["Resources"].get("CPU", 0) >= resources["num_cpus"]]
    known = folder.read_json("level.json")
    probe = ray.remote(worker.probe)
    asked = [
        probe.options(
            num_cpus=0, max_retries=0, scheduling_strategy=NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
        ).remote(run | {"level": known})
        for node in able
    ]
    answers = []
    for node, ref in zip(able, asked, strict=True):
        try:
            answers.append(ray.get(ref, timeout=PROBE_SECONDS))
        except ray.exceptions.RayError as error:
            if not any(alive["Alive"] and alive["NodeID"] == node["NodeID"] for alive in ray.nodes()):
                continue  # it died meanwhile
            answers.append({"node": node["NodeManagerAddress"], "problem": f"does not answer ({error})"})
    unfit = [f"node {answer['node']} {answer['problem']}" for answer in answers if "problem" in answer]
    levels = {answer["level"]: answer["node"] for answer in answers if "level" in answer}
    if len(levels) > 1:
        named = ", ".join(f"{node} has {level}" for level, node in sorted(levels.items()))
        unfit.append(f"the nodes have different processor levels: {named}; results would depend on the node")
    if unfit:
        raise RunRefused("; ".join(unfit))
    if known is None and levels:
        folder.write_json("level.json", next(iter(levels)))
    return known or next(iter(levels), None)


def _run_stage(
    cells: Iterable[worker.Cell],
    finished: set[str],
    run: dict[str, Any],
    resources: dict[str, Any],
    supply: Supply,
    progress: _Progress,
) -> int:
    """Runs the cells of a stage that are not done, and returns their number."""
    task = ray.remote(worker.run_cell).options(max_retries=RETRIES, retry_exceptions=True, **resources)
    shared = ray.put(run)
    missing, running, failed, ran, waits = iter(cells), {}, [], 0, True
    while True:
        for cell in missing:
            if cell["id"] in finished:
                progress.advance()
                continue
            running[task.remote(cell, shared)] = cell["name"]
            if len(running) >= QUEUED:
                break
        if not running:
            break
        try:
            if waits:
                supply.check()
            else:
                supply.served()
            ray.wait(list(running), timeout=min(PROGRESS_SECONDS, max(0.1, supply.seconds)))
            ready, _ = ray.wait(list(running), num_returns=len(running), timeout=0)
            waits = not ready
            for ref in ready:
                name = running.pop(ref)
                problem = _problem(ref, name)
                if problem is None:
                    ran += 1
                    progress.advance()
                else:
                    failed.append(problem)
        except BaseException:
            for ref in running:
                ray.cancel(ref)
            raise
        progress.show()
        if len(failed) >= HOPELESS and ran == 0:
            for ref in running:
                ray.cancel(ref)
            break
    if failed:
        kept = f"{progress.done} of {progress.total} cells are done and kept"
        raise CellsFailed(
            "\n".join([f"{len(failed)} cells failed after {1 + RETRIES} attempts each; {kept}", *failed[:HOPELESS]])
        )
    return ran


def _problem(ref: Any, name: str) -> str | None:
    """Why a cell failed after all retries; `None` if it is done."""
    try:
        ray.get(ref)
    except ray.exceptions.RayTaskError as error:
        return str(error.cause)
    except ray.exceptions.TaskCancelledError:
        raise KeyboardInterrupt from None
    except ray.exceptions.RayError as error:
        return f"cell '{name}': {error}"
    return None


class _Progress:
    """Prints how many cells are done, at most every few seconds."""

    def __init__(self, total: int) -> None:
        self.total, self.done = total, 0
        self._shown, self._at = -1, 0.0

    def advance(self) -> None:
        self.done += 1

    def show(self) -> None:
        now = time.monotonic()
        if self.done != self._shown and (now - self._at >= PROGRESS_SECONDS or self.done == self.total):
            print(f"ray: {self.done} of {self.total} cells", file=sys.stderr, flush=True)
            self._shown, self._at = self.done, now
