"""What a cell takes of a node, and whether a node of the cluster has it."""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import ray

__all__ = ["RunRefused", "Supply", "task_options"]

#: Seconds that cells wait for a node that has what they take, unless the request says how many.
WAIT_SECONDS = 60
#: Where autoscalers before the second version write what they do.
_STATUS = b"__autoscaling_status"


class RunRefused(RuntimeError):
    """The run cannot begin or continue."""


def task_options(resources: dict[str, float]) -> dict[str, Any]:
    """What a cell takes, as options of a Ray task."""
    others = {name: count for name, count in resources.items() if name not in ("cpu", "gpu", "memory")}
    options: dict[str, Any] = {"num_cpus": resources.get("cpu", 1), "num_gpus": resources.get("gpu", 0), "resources": others}
    if "memory" in resources:
        options["memory"] = resources["memory"]
    return options


class Supply:
    """Ends a run whose cells wait for a node that does not join.

    Args:
        resources: What a cell takes, as in a request.
        seconds: How long cells wait for a node that has it. While an autoscaler starts nodes, the time begins anew.
    """

    def __init__(self, resources: dict[str, float], seconds: float) -> None:
        asked = {"cpu": 1.0, **resources}
        self._asked, self.seconds = {name: count for name, count in asked.items() if count}, seconds
        self._since: float | None = None

    def served(self) -> None:
        """Notes that cells run, so that a later wait begins anew."""
        self._since = None

    def check(self) -> None:
        """Warns when no node has what a cell takes.

        Raises:
            RunRefused: If none has had it for too long.
        """
        nodes: list[dict[str, float]] = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        if any(self._count(node) == len(self._asked) for node in nodes):
            self._since = None
            return
        now, asked = time.monotonic(), _named(self._asked)
        largest = max(nodes, key=lambda node: (self._count(node), node.get("CPU", 0)), default={})
        found = _named({name: _of(largest, name) for name in self._asked})
        if self._since is None:
            text = f"no node has {asked}, which a cell takes: the largest one has {found}"
            print(f"warning: {text}; waiting {self.seconds:g} s for one to join", file=sys.stderr, flush=True)
            self._since = now
        elif _nodes_start():
            self._since = now
        elif now - self._since >= self.seconds:
            raise RunRefused(
                f"no node has {asked}, which a cell takes: the largest one has {found}, and none joined within "
                f"{self.seconds:g} s; ask for less with --resources, add such a node to the cluster, or wait longer with "
                "--wait SECONDS; finished cells are kept"
            )

    def _count(self, node: dict[str, float]) -> int:
        """How many of the resources a node has."""
        return sum(_of(node, name) >= count for name, count in self._asked.items())


def _of(node: dict[str, float], name: str) -> float:
    """How much of a resource a node has."""
    return node.get({"cpu": "CPU", "gpu": "GPU"}.get(name, name), 0)


def _named(counts: dict[str, float]) -> str:
    return ", ".join(f"{name}={count:.12g}" for name, count in counts.items())


def _nodes_start() -> bool:
    """Whether an autoscaler starts nodes, as far as Ray tells."""
    try:
        from ray.autoscaler.v2.sdk import get_cluster_status

        status = get_cluster_status(ray.get_runtime_context().gcs_address)
        if status.pending_launches or status.pending_nodes:
            return True
    except Exception:  # no part of Ray's interface
        pass
    try:
        from ray.experimental.internal_kv import _internal_kv_get

        report = json.loads(_internal_kv_get(_STATUS) or b"{}").get("autoscaler_report") or {}
        return bool(report.get("pending_nodes") or report.get("pending_launches"))
    except Exception:
        return False
