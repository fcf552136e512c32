"""`Metrics`: the result of an evaluation."""

from __future__ import annotations

import json
import math
import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from .. import _files

__all__ = ["Metrics"]


class Metrics(dict[str, Any]):
    """The metrics of an evaluation.

    Keys: `success_rate` in percent, NaN if no episode counts because all starts satisfy the goal; `interval`, its 95 % Wilson
    interval; `random_success_rate` and `random_interval`, the success rate and interval of the random-policy floor;
    `episode_successes`, `seeds` and `steps`, one entry for each episode; `solved_at_start`, the number of starts that satisfy
    the goal; `time_to_goal`, the steps of successful episodes; `plan_seconds`, the planning times; `videos`, their
    names in the folder of the evaluation's argument `video`.
    """

    results: dict[str, Any]

    #: The videos at the end of the evaluation: their names in the results, paths, sizes and times of writing.
    _videos: list[tuple[str, Path, tuple[int, int] | None]]

    @classmethod
    def _of(cls, manifest: dict[str, Any], runs: list[dict[str, Any]], videos: Path | None) -> Metrics:
        """The metrics of runs with this manifest, the first of the policy; `videos` is the folder of its videos."""
        config = manifest["config"]
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
        metrics.results = {
            "manifest": manifest,
            "env": config["env"],
            "protocol": "episodic" if config["dataset"] is None else "dataset",
            "counting": config["counting"],
            "runs": [*floors, run],
            "comparisons": [],
        }
        paths = [] if videos is None else [(name, videos.absolute() / name) for name in run["videos"]]
        metrics._videos = [(name, path, _state(path)) for name, path in paths]
        return metrics

    def save(self, path: str | Path = "results.json") -> Path:
        """Writes the results as JSON, the input of `swm report`, and returns the path. Older results there are replaced.

        The file names videos relative to its folder; `swm report` shows those in this folder or below. Videos that were
        replaced or moved since the evaluation are left out, with a warning.

        Raises:
            FileExistsError: If there is another file.
            ValueError: If the path is a URI.
        """
        path = _files.local("path", path)
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and path.stat().st_size > 0 and not _is_results(path):
            raise FileExistsError(f"{path}: this file holds no results; choose another name, or remove it")
        text = json.dumps(self._located(path.parent), indent=2)
        _files.replace({path: lambda beside: beside.write_text(text)})
        return path

    def _located(self, folder: Path) -> dict[str, Any]:
        """The results with the videos of the policy's run as paths relative to a folder."""
        known = getattr(self, "_videos", [])
        if not known:
            return self.results
        kept = {name: path for name, path, state in known if state is not None and _state(path) == state}
        if len(kept) < len(known):
            lost = sorted({name for name, *_ in known} - set(kept))
            warnings.warn(
                f"Metrics.save: {', '.join(lost)}: these videos were replaced or moved since the evaluation, so the results do "
                "not name them; give each evaluation its own folder (video=…), and save the results before moving it",
                stacklevel=3,
            )
        *others, run = self.results["runs"]
        named = [kept[name] for name in run["videos"] if name in kept]
        base = folder.resolve()
        relative = [Path(os.path.relpath(path.parent.resolve() / path.name, base)).as_posix() for path in named]
        return {**self.results, "runs": [*others, {**run, "videos": relative}]}

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


def _state(path: Path) -> tuple[int, int] | None:
    """The size of a file and the time at which it was written; `None` if there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_size, found.st_mtime_ns


def _is_results(path: Path) -> bool:
    """Whether a file holds results of an evaluation."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(found, dict) and {"manifest", "runs"} <= found.keys()


def _rate(success: dict[str, Any]) -> float:
    """The rate in percent. The engine states 0 where no episode counts."""
    return _percent(success["rate"]) if success["n"] else math.nan


def _percent(rate: float | None) -> float:
    return math.nan if rate is None else 100.0 * rate
