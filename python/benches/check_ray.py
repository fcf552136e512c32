"""Checks at full size that runs on a Ray cluster have the results of one process while nodes and drivers are killed.

    ~/.cache/swm/venv-ray-1/bin/python python/benches/check_ray.py [collect|eval|train] [--kills 20]

A real cluster of a head and three nodes of one CPU each, and a real S3 server on loopback. Each workload runs, to a new output
each time, until a node was killed the given number of times at random moments; the driver is killed once in each run and
started again. The small version of this is part of `make test-ray`.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests_ray"))
os.environ.setdefault("SWM_ZOO", str(Path(__file__).parents[2] / "zoo"))

import boto3
import conftest
import ray
from conftest import add_node, content_hash, printed
from moto.server import ThreadedMotoServer
from ray.cluster_utils import Cluster

from stable_worldmodel.ray.folder import Folder

COLLECT = ["swm/PushT-v1", "--episodes", "2000", "--image", "64", "--policy", "random", "--max-steps", "60", "--seed", "7"]
GREYS = [part for level in range(0, 247, 19) for part in ("--shift", f"agent.color={level},{level},{level}")]
SOLVER = ["--solver", "cem,samples=64,iterations=3,elites=8", "--horizon", "4", "--receding-horizon", "1"]
EVAL = ["zoo:two-room/pldm", "--episodes", "10", "--budget", "50", "--seed", "3", *SOLVER, *GREYS]
TRAIN = ["lewm", "--preset", "tiny", "schedule.steps=120", "save_every=20", "data.batch_size=32"]
SEEDS = range(8)


def results(location: str) -> dict:
    """Results of an evaluation without times and videos."""
    found = Folder(location).read_json("results.json")
    for run in found["runs"]:
        run.pop("timing")
        run.pop("videos")
    return found


def weights(location: str) -> bytes:
    """The weights of a training."""
    return Folder(location).read("checkpoint/weights.safetensors") or b""


class Killer:
    """Kills a node of the cluster at random moments, and adds another one."""

    def __init__(self, cluster: Cluster, seed: int) -> None:
        self.cluster, self.random, self.kills = cluster, random.Random(seed), 0
        self.nodes = [add_node(cluster) for _ in range(3)]

    def run(self, arguments: list[str], longest: float) -> float:
        """Runs a command on the cluster while nodes die; returns its seconds."""
        command = [sys.executable, "-m", "stable_worldmodel", *arguments, "--on", "ray", "--json"]
        began, driver_lives = time.monotonic(), self.random.uniform(2, longest)
        process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
        )
        due = began + self.random.uniform(1, longest)
        while process.poll() is None:
            time.sleep(0.05)
            if driver_lives and time.monotonic() - began > driver_lives:
                driver_lives = 0.0
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
                process = subprocess.Popen(
                    command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
                )
            if time.monotonic() > due:
                node = self.nodes.pop(self.random.randrange(len(self.nodes)))
                self.cluster.remove_node(node, allow_graceful=False)
                self.nodes.append(add_node(self.cluster))
                self.kills += 1
                due = time.monotonic() + self.random.uniform(1, longest)
        errors = process.stderr.read() if process.stderr else ""
        assert process.returncode == 0, errors
        return time.monotonic() - began


def main() -> None:
    """Runs the workloads."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("workloads", nargs="*", default=["collect", "eval", "train"])
    parser.add_argument("--kills", type=int, default=20)
    given = parser.parse_args()
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    os.environ["AWS_ENDPOINT_URL"] = f"http://{host}:{port}"
    boto3.client("s3", endpoint_url=os.environ["AWS_ENDPOINT_URL"]).create_bucket(Bucket="lab")
    local = Path(tempfile.mkdtemp(prefix="swm-check-"))
    os.environ["STABLEWM_HOME"] = str(local / "home")
    head = {"num_cpus": 1, "object_store_memory": conftest.STORE, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    os.environ["RAY_ADDRESS"] = cluster.address
    ray.init(address=cluster.address, log_to_driver=False)
    killer = Killer(cluster, seed=1)
    for workload in given.workloads:
        began = time.monotonic()
        if workload == "collect":
            printed("collect", *COLLECT, "-o", local / "one.lance")
            expected, longest = content_hash(local / "one.lance"), 8.0
        elif workload == "eval":
            printed("eval", *EVAL, "-o", local / "eval", "--videos", "0")
            expected, longest = results(str(local / "eval")), 8.0
        else:
            data = str(local / "train.lance")
            rooms = ["--episodes", "40", "--image", "64", "--policy", "random", "--max-steps", "60"]
            printed("collect", "swm/TwoRoom-v1", "-o", data, *rooms)
            for seed in SEEDS:
                printed("train", *TRAIN, "--data", data, "-o", local / f"seed={seed}", f"seed={seed}")
            expected, longest = [weights(str(local / f"seed={seed}")) for seed in SEEDS], 8.0
        alone, killer.kills, runs, seconds = time.monotonic() - began, 0, 0, []
        while killer.kills < given.kills:
            output = f"s3://lab/{workload}-{runs}" + (".lance" if workload == "collect" else "")
            runs += 1
            if workload == "collect":
                seconds.append(killer.run(["collect", *COLLECT, "-o", output], longest))
                assert content_hash(output) == expected
            elif workload == "eval":
                seconds.append(killer.run(["eval", *EVAL, "-o", output], longest))
                assert results(output) == expected
            else:
                sweep = f"seed={','.join(map(str, SEEDS))}"
                seconds.append(killer.run(["train", *TRAIN, "--data", data, "-o", output, "--sweep", sweep], longest))
                assert [weights(f"{output}/seed={seed}") for seed in SEEDS] == expected
        times = ", ".join(f"{value:.0f}" for value in seconds)
        report = {"workload": workload, "kills": killer.kills, "driver kills": runs, "equal": True}
        print(f"{json.dumps(report)}; one process {alone:.0f} s, runs {times} s", flush=True)
    ray.shutdown()
    cluster.shutdown()
    server.stop()


if __name__ == "__main__":
    main()
