"""`fit`: one training in PyTorch by several processes of a Ray cluster, with Ray Train.

Ray Train starts the processes, and starts all of them again if one of them or its node dies. The processes divide each batch
as those of `torchrun` do, so their number changes the result by rounding only.
"""

from __future__ import annotations

import dataclasses
import os
import sys
import time
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import ray

from .. import _engine
from ..train.options import Options, called
from .supply import WAIT_SECONDS, RunRefused

__all__ = ["fit", "fitted"]

#: How often the processes are started again after one of them died.
_RESTARTS = 3
#: A file in the folder of Ray Train that tells a training of `fit` from other files.
_MARK = ".swm-fit"


def fit(
    family: str,
    data: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *settings: str,
    workers: int = 2,
    resources: Mapping[str, float] | None = None,
    wait: float = WAIT_SECONDS,
    **options: Any,
) -> str:
    """Trains one model with several processes, and returns the folder of its checkpoint.

    If a process or a node dies, the training continues from its last checkpoint (`save_every`), at most three times.

    Args:
        family: The model, as for `stable_worldmodel.train.train`.
        data: The dataset: a URI, or a path on a disk that all nodes share.
        out: The checkpoint: a path on a disk that all nodes share.
        *settings: Settings of the configuration, such as `"model.latent=4"`.
        workers: The number of processes.
        resources: What a process takes of its node, as `cpu`, `gpu` and other resources of Ray; by default one CPU, and one
            GPU if the cluster has any and `device` is not `cpu`.
        wait: Seconds to wait for nodes, if the cluster has too little.
        **options: The other attributes of `stable_worldmodel.train.Options`; names with `__` are settings.

    Raises:
        RunRefused: If the cluster has too little, or the processes died too often.
        ValueError: If a setting is invalid, or the folder of the checkpoint holds a run.
    """
    given = called(family, os.fspath(data), settings, {"out": os.fspath(out), **options})
    return fitted(dataclasses.replace(given, workers=workers), resources, wait)


def fitted(options: Options, resources: Mapping[str, float] | None = None, wait: float = WAIT_SECONDS) -> str:
    """Trains with `options.workers` processes; see `fit`."""
    try:
        from ray.train import FailureConfig, RunConfig, ScalingConfig
        from ray.train.torch import TorchTrainer
    except ImportError as error:
        raise ImportError(f'Ray Train is not installed ({error}): pip install "ray[train]"') from error
    from .local import connect

    run = options.run.resolve()
    storage = run.with_name(run.name + ".ray")
    if not options.resume and _holds_checkpoint(run):
        raise ValueError(f"{run}: holds a checkpoint; continue it with resume=true, or choose another folder")
    # Ray Train takes up what it finds in its folder.
    mark = storage / "train" / _MARK
    if mark.parent.exists() and not mark.is_file() and not _holds_checkpoint(run):
        raise ValueError(
            f"{mark.parent}: exists, and no training made it; move it away, or choose another folder for the checkpoint"
        )
    # Processes have another current folder. Their first start is told from a restart by the checkpoint.
    data = str(Path(options.data).resolve()) if Path(options.data).exists() else options.data
    preset = str(Path(options.preset).resolve()) if options.preset and Path(options.preset).is_file() else options.preset
    options = dataclasses.replace(options, data=data, preset=preset, out=str(run), resume=True)
    connect()
    asked = _resources(options, resources)
    _wait_for(options.workers, asked, wait)
    mark.parent.mkdir(parents=True, exist_ok=True)
    mark.touch()
    refused = storage / f"refused-{uuid.uuid4().hex}.txt"
    trainer = TorchTrainer(
        _rank,
        train_loop_config={"options": dataclasses.asdict(options), "refused": str(refused)},
        scaling_config=ScalingConfig(
            num_workers=options.workers, use_gpu=asked.get("GPU", 0) > 0, resources_per_worker=dict(asked)
        ),
        run_config=RunConfig(name="train", storage_path=str(storage), failure_config=FailureConfig(max_failures=_RESTARTS)),
    )
    try:
        trainer.fit()
    except Exception as error:
        # Errors of Ray Train name its own classes, and the cause last.
        cause = str(error).strip().splitlines()[-1] if str(error).strip() else type(error).__name__
        kept = (
            "its last checkpoint is kept, and resume=true continues it" if _holds_checkpoint(run) else "it made no checkpoint"
        )
        raise RunRefused(f"the training in {run} ended after {_RESTARTS} restarts: {cause}; {kept}") from error
    if refused.exists():
        raise ValueError(refused.read_text(encoding="utf-8"))
    return str(run)


def _holds_checkpoint(run: Path) -> bool:
    return any((run / name).exists() for name in _engine.CHECKPOINT_FOLDERS)


def _rank(config: dict[str, Any]) -> None:
    """Trains in a process that Ray Train has started, which ends the group of processes itself."""
    from ..train.loop import Trainer

    try:
        Trainer(Options(**config["options"])).train()
    except (ValueError, TypeError, KeyError, FloatingPointError) as error:
        # The same error would end every restart, so this is no failure for Ray Train.
        path = Path(config["refused"])
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(str(error), encoding="utf-8")


def _resources(options: Options, given: Mapping[str, float] | None) -> dict[str, float]:
    """What a process takes, by Ray's names."""
    names = {"cpu": "CPU", "gpu": "GPU"}
    found = {names.get(name, name): float(count) for name, count in (given or {}).items()}
    if "GPU" not in found and options.device != "cpu" and ray.cluster_resources().get("GPU"):
        found["GPU"] = 1.0
    return {"CPU": 1.0, **found}


def _wait_for(workers: int, asked: Mapping[str, float], seconds: float) -> None:
    """Waits until the nodes have what all processes take together.

    Raises:
        RunRefused: If they do not within the time.
    """
    begin, warned = time.monotonic(), False
    while True:
        places = 0
        for node in ray.nodes():
            if node["Alive"]:
                has = node["Resources"]
                places += int(min(has.get(name, 0) // count for name, count in asked.items() if count))
        if places >= workers:
            return
        text = ", ".join(f"{name}={count:g}" for name, count in asked.items() if count)
        text = f"{workers} processes take {text} each, and the nodes have room for {places}"
        if time.monotonic() - begin >= seconds:
            raise RunRefused(f"{text}; choose fewer workers, add nodes, or wait longer")
        if not warned:
            print(f"warning: {text}; waiting {seconds:g} s for nodes", file=sys.stderr, flush=True)
            warned = True
        time.sleep(1)
