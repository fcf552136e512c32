"""Runs on a Ray cluster: collections, evaluations, studies, sweeps of trainings and conversions (`docs/ray.md`).

    import ray, stable_worldmodel as swm

    done = swm.ray.collect("swm/PushT-v1", "s3://lab/pusht.lance", episodes=2000, resources={"cpu": 2})
    swm.ray.progress("s3://lab/pusht.lance.ray")  # {"done": 12, "cells": 41}
    ray.get(done)

Each function returns a Ray object reference at once: `ray.get` waits for it, `ray.wait` watches it, `ray.cancel` ends the run,
and `await` works. The arguments are those of the `swm` command of the same name. The folder of the run, by default the output
with the suffix `.ray`, is the only state: the same call continues a run that ended early, from any machine.

`pip install "stable-worldmodel-rs[ray]"` installs Ray, whose version must be the same on all nodes.
"""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Mapping, Sequence
from typing import Any

try:
    import ray
except ImportError as error:
    raise ImportError('Ray is not installed: pip install "stable-worldmodel-rs[ray]"') from error

from .. import _options
from .._process import module_command
from .driver import CellsFailed, RunRefused, execute, read_request
from .fit import fit
from .folder import Folder
from .local import connect

__all__ = ["CellsFailed", "RunRefused", "collect", "convert", "evaluate", "fit", "progress", "study", "submit", "train"]


def collect(env: str, output: str | os.PathLike[str], **options: Any) -> ray.ObjectRef:
    """Collects episodes in shards, as `swm collect`.

    Args:
        env: The environment.
        output: The Lance dataset to write: a URI, or a path on a disk that all nodes share.
        **options: Options of `swm collect` with `_` for `-`, `shards`, `resources` (a dict), `wait` and `run_folder`.

    Returns:
        A reference to a dict: `output`, `folder`, `cells`, `ran` and `seconds`.
    """
    return submit(["collect", env, "--output", os.fspath(output)], options)


def convert(source: str | os.PathLike[str], target: str | os.PathLike[str], **options: Any) -> ray.ObjectRef:
    """Converts a dataset to a Lance dataset in shards, as `swm convert`; see `collect`."""
    return submit(["convert", os.fspath(source), os.fspath(target)], options)


def evaluate(policies: str | Sequence[str], output: str | os.PathLike[str], **options: Any) -> ray.ObjectRef:
    """Evaluates policies under each condition apart, as `swm eval`; see `collect`.

    The output is a folder with `results.json`, equal to that of one process but for its times.
    """
    named = [policies] if isinstance(policies, str) else list(policies)
    return submit(["eval", *named, "--output", os.fspath(output)], options)


def study(
    study: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    small: bool = False,
    trust: bool = False,
    until: str | None = None,
    resources: Mapping[str, float] | None = None,
    wait: int | None = None,
    run_folder: str | None = None,
    **settings: Any,
) -> ray.ObjectRef:
    """Evaluates the cells of a study that have no results in the output, as `swm.studies.run`; see `collect`.

    With `until`, such as `ci=5`, the results decide how many starts are played, in stages.
    """

    arguments = ["study", "run", os.fspath(study), "--output", os.fspath(output)]
    arguments += [f"{name.replace('_', '-')}={_options.setting(value, name)}" for name, value in settings.items()]
    options = {"small": small, "trust": trust, "until": until, "resources": resources, "wait": wait, "run_folder": run_folder}
    return submit(arguments, options)


def train(
    model: str,
    output: str | os.PathLike[str],
    *settings: str,
    sweep: Mapping[str, Sequence[Any]] | None = None,
    **options: Any,
) -> ray.ObjectRef:
    """Trains a model once for every combination of the values in `sweep`, as `swm train`; see `collect`.

    Each run is a folder of the output, such as `seed=0,optim.lr=0.001`.
    """
    swept = [f"{key}={','.join(_options.setting(value, key) for value in values)}" for key, values in (sweep or {}).items()]
    return submit(["train", model, *settings, "--output", os.fspath(output)], options | {"sweep": swept})


def submit(arguments: Sequence[str], options: Mapping[str, Any] | None = None) -> ray.ObjectRef:
    """Begins or continues the run of a `swm` command.

    Args:
        arguments: The command and its positional arguments.
        options: More options by their names, with `_` for `-`; a list repeats an option, `True` is a flag, `None` is left out.
    """
    command = module_command("stable_worldmodel", *arguments, *_flags(options or {}), "--on", "ray", "--print-request")
    made = subprocess.run(command, capture_output=True, text=True)
    if made.returncode:
        raise ValueError(made.stderr.strip().removeprefix("error: "))
    connect()
    # The driver is a task itself, so the run goes on while this process does other things.
    return ray.remote(execute).options(num_cpus=0, max_retries=3).remote(json.loads(made.stdout))


def progress(folder: str | os.PathLike[str]) -> dict[str, int]:
    """How many cells of a run are `done`, of how many `cells`, from its folder.

    While results decide which cells there are (`until`, `swm study break`), `cells` is the largest number that there may be.
    """
    from .cells import count

    run = Folder(os.fspath(folder))
    request = read_request(run)
    if request is None:
        return {"done": 0, "cells": 0}
    done = run.list("cells")
    # A rule has ended it.
    ended = any(name in request["cells"] for name in ("stages", "inside")) and "join.json" in done
    return {"done": len(done), "cells": len(done) if ended else count(request)}


def _flags(options: Mapping[str, Any]) -> list[str]:
    """Options as arguments of a command."""
    flags = []
    for name, value in options.items():
        flag = f"--{name.replace('_', '-')}"
        if isinstance(value, Mapping):
            flags += [flag, ",".join(f"{key}={count}" for key, count in value.items())]
        elif isinstance(value, (list, tuple)):
            flags += [part for item in value for part in (flag, str(item))]
        elif value is True:
            flags.append(flag)
        elif value is not None and value is not False:
            flags += [flag, str(value)]
    return flags
