"""`Metrics`: the result of an evaluation."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import _engine, _files

if TYPE_CHECKING:
    from .world import World

__all__ = ["Metrics"]


class Metrics(dict[str, Any]):
    """The metrics of an evaluation.

    Keys: `success_rate` in percent, NaN if no episode counts because all starts satisfy the goal; `interval`, its 95 % Wilson
    interval; `random_success_rate` and `random_interval`, the success rate and interval of the random-policy floor;
    `episode_successes`, `seeds` and `steps`, one entry for each episode; `solved_at_start`, the number of starts that satisfy
    the goal; `time_to_goal`, the steps of successful episodes; `plan_seconds`, the planning times; `videos`.
    """

    results: dict[str, Any]

    @classmethod
    def _of(cls, world: World, config: dict[str, Any], runs: list[dict[str, Any]], dataset: str | None) -> Metrics:
        run, *floors = runs
        played = run["episodes"]
        metrics = cls(
            success_rate=_rate(run["success"]),
            interval=tuple(_percent(run["success"][side]) for side in ("low", "high")),
            episode_successes=np.array([episode["success"] for episode in played], dtype=bool),
            seeds=np.array([episode["seed"] for episode in played], dtype=np.int64),
            steps=np.array([episode["steps"] for episode in played], dtype=np.int64),
            solved_at_start=run["solved_at_start"],
            time_to_goal=run["time_to_goal"],
            plan_seconds=run["timing"]["plan_seconds"],
            seed=config["seed"],
            videos=run["videos"],
        )
        if floors:
            floor = floors[0]["success"]
            metrics["random_success_rate"] = _rate(floor)
            metrics["random_interval"] = tuple(_percent(floor[side]) for side in ("low", "high"))
        manifest = {
            "kind": "evaluate",
            "swm_version": _engine.__version__,
            "libraries": json.loads(world._world.libraries()),
            "seed": config["seed"],
            "config": {**config, "env": world.env_name, "num_envs": world.num_envs, "dataset": dataset, "front": "python"},
            "hashes": {},
            "device": "cpu",
        }
        metrics.results = {
            "manifest": manifest,
            "env": world.env_name,
            "protocol": "episodic" if dataset is None else "dataset",
            "counting": config["counting"],
            "runs": [*floors, run],
            "comparisons": [],
        }
        return metrics

    def save(self, path: str | Path = "results.json") -> Path:
        """Writes the results as JSON, the input of `swm report`, and returns the path. Older results there are replaced.

        Raises:
            FileExistsError: If there is another file.
            ValueError: If the path is a URI.
        """
        path = _files.local("path", path)
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and path.stat().st_size > 0 and not _is_results(path):
            raise FileExistsError(f"{path}: this file holds no results; choose another name, or remove it")
        text = json.dumps(self.results, indent=2)
        _files.replace({path: lambda beside: beside.write_text(text)})
        return path

    def __str__(self) -> str:
        low, high = self["interval"]
        counted = self.results["runs"][-1]["success"]["n"]
        if not counted:
            return f"no episode counts: {self['solved_at_start']} of {len(self['seeds'])} starts satisfy the goal already"
        text = f"{self['success_rate']:.1f} % [{low:.0f}, {high:.0f}] of {counted} episodes"
        if "random_success_rate" in self:
            low, high = self["random_interval"]
            text += f", at random {self['random_success_rate']:.1f} % [{low:.0f}, {high:.0f}]"
        return text


def _is_results(path: Path) -> bool:
    """Whether a file holds results of an evaluation."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return False
    return isinstance(found, dict) and {"manifest", "runs"} <= found.keys()


def _rate(success: dict[str, Any]) -> float:
    """The rate in percent. The engine states 0 where no episode counts."""
    return _percent(success["rate"]) if success["n"] else math.nan


def _percent(rate: float | None) -> float:
    return math.nan if rate is None else 100.0 * rate
