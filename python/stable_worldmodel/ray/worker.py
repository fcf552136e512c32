"""What a node does: one cell, which is the `swm` command in a process of its own.

Ray sends this module by value, so it imports nothing but the standard library before a cell runs: a node without this package,
or with another version of it, answers with an error that names the node.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

#: A cell: `id`, `name` and `arguments` of `swm`; `files`, texts to write first, by their paths in the folder of the cell;
#: `inputs` and `outputs`, locations by these paths, with a question mark after what may be missing; `state`, the folder of
#: a training's checkpoints; `trains`, the path of that training if its command continues it without being told; `study`, the
#: title of the study whose files the outputs may replace; `done_if`, a command, and the values that it prints if the work is
#: done already.
Cell = dict[str, Any]

#: What the cells of a run share: `folder`, `version`, `level`, `directory` and `threads`.
Run = dict[str, Any]

#: The folder of a cell on its node, in arguments.
SCRATCH = "{scratch}"
#: How much of what a command prints is kept, in characters.
KEPT = 4000
#: Seconds between two looks at the checkpoints of a training.
SYNC_SECONDS = 5.0


def node_name() -> str:
    """The name and the address of this node."""
    try:
        import ray

        context = ray.get_runtime_context()
        address = f"{ray.util.get_node_ip_address()}, {context.get_node_id()[:8]}"
    except Exception:  # outside Ray
        address = str(os.getpid())
    return f"{socket.gethostname()} ({address})"


def probe(run: Run) -> dict[str, str]:
    """What decides whether this node may run cells: `node`, and `problem` or `level`."""
    node = node_name()
    try:
        import stable_worldmodel
        from stable_worldmodel import _engine

        version, level = stable_worldmodel.__version__, _engine.cpu_level()
    except Exception as error:
        return {"node": node, "problem": f"cannot import the package stable_worldmodel ({error}); install it on every node"}
    if version != run["version"]:
        fix = "install the same version on every node"
        return {"node": node, "problem": f"has version {version} of stable_worldmodel, and the run {run['version']}; {fix}"}
    if run.get("level") not in (None, level):
        fix = "take nodes with the same processor level, on which the last bits of results depend"
        return {"node": node, "problem": f"has the processor level {level}, and the run {run['level']}; {fix}"}
    return {"node": node, "level": level}


def run_cell(cell: Cell, run: Run) -> dict[str, Any]:
    """Runs a cell and writes its record, unless it has one.

    Raises:
        RuntimeError: If it fails. It names the cell, the node and the cause.
    """
    found = probe(run)
    where = f"cell '{cell['name']}' on node {found['node']}"
    if "problem" in found:
        raise RuntimeError(f"{where}: the node {found['problem']}")
    from stable_worldmodel.ray.folder import Folder

    records = Folder(run["folder"])
    try:
        record = records.read_json(f"cells/{cell['id']}.json")
        if record is not None:
            return dict(record)
        began = time.monotonic()
        with tempfile.TemporaryDirectory(prefix="swm-cell-") as scratch:
            outcome = _run_in(Path(scratch), cell, run)
        record = {"id": cell["id"], "name": cell["name"], "node": found["node"], "seconds": round(time.monotonic() - began, 3)}
        text = json.dumps(outcome)
        records.write_json(f"cells/{cell['id']}.json", record | {"outcome": outcome if len(text) <= KEPT else None})
    except KeyboardInterrupt:
        raise
    except Exception as error:
        raise RuntimeError(f"{where}: {error}") from None
    return record


def _run_in(scratch: Path, cell: Cell, run: Run) -> Any:
    """Brings the files of a cell, runs its command, and stores its outputs. Returns what the command printed."""
    from stable_worldmodel.ray.folder import Folder, Outputs, TrainingState

    for name, text in cell.get("files", {}).items():
        path = scratch / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    arguments = [argument.replace(SCRATCH, str(scratch)) for argument in cell["arguments"]]
    state = TrainingState(cell["state"], scratch / cell.get("trains", "run")) if cell.get("state") else None
    continued = state is not None and state.restore()
    if continued and "trains" not in cell:
        arguments.append("--resume")
    for name, location in cell.get("inputs", {}).items():
        # The state of this run is newer than what another run left in the output.
        if not (continued and name.rstrip("?") == cell.get("trains")):
            Folder(location).download(scratch / name.rstrip("?"), missing_ok=name.endswith("?"))
    try:
        outcome = _command(arguments, run, state)
    except RuntimeError:
        if not _is_done(cell, run):
            raise
        outcome = None
    outputs = Outputs(Folder(run["folder"]), cell["id"], cell.get("study"))
    for name, location in cell.get("outputs", {}).items():
        if (scratch / name.rstrip("?")).exists() or not name.endswith("?"):
            outputs.upload(scratch / name.rstrip("?"), Folder(location))
    return outcome


def _is_done(cell: Cell, run: Run) -> bool:
    """Whether an earlier attempt, which ended before it wrote its record, did the work."""
    if "done_if" not in cell:
        return False
    arguments, values = cell["done_if"]
    try:
        outcome = _command(arguments, run, None)
    except RuntimeError:
        return False
    return isinstance(outcome, dict) and all(outcome.get(key) == value for key, value in values.items())


def _command(arguments: list[str], run: Run, state: Any) -> Any:
    """Runs `swm` with these arguments and returns the JSON that it prints. It ends when this process does."""
    if "--threads" not in arguments:
        arguments = [*arguments, "--threads", str(run["threads"])]
    from stable_worldmodel._process import module_command

    program = module_command("stable_worldmodel", *arguments, "--json")
    directory = run["directory"] if os.path.isdir(run["directory"]) else None
    with tempfile.TemporaryFile() as printed, tempfile.TemporaryFile() as errors:
        child = subprocess.Popen(
            program, cwd=directory, stdin=subprocess.DEVNULL, stdout=printed, stderr=errors, preexec_fn=_ending_with_parent()
        )
        stop = threading.Event()
        watcher = threading.Thread(target=state.watch, args=(stop, SYNC_SECONDS), daemon=True) if state else None
        try:
            if watcher:
                watcher.start()
            code = child.wait()
        finally:
            stop.set()
            if child.poll() is None:
                child.kill()
                child.wait()
            if watcher:
                watcher.join()
        printed.seek(0)
        errors.seek(0)
        text = errors.read().decode(errors="replace").strip()
        if code:
            ended = f"was ended by the signal {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
            raise RuntimeError(f"`swm {' '.join(arguments[:2])}` {ended}: {text[-KEPT:]}")
        try:
            return json.loads(printed.read())
        except ValueError:
            return None


def _ending_with_parent() -> Any:
    """A function that asks Linux to kill a child when its worker ends, so that no orphan writes beside a retry."""
    if sys.platform != "linux":
        return None
    prctl = ctypes.CDLL(None).prctl  # found before the fork, which copies the locks of other threads
    return lambda: prctl(1, signal.SIGKILL)
