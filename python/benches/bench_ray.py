"""The overhead of runs on a Ray cluster.

    ~/.cache/swm/venv-ray-1/bin/python python/benches/bench_ray.py [cells|queue|cost|requests|commit]

- `cells`: 200 cells that sleep for one second on four slots of a warm cluster; 50 s are the sleep itself.
- `queue`: 10,000 cells in Ray's queue, and the memory of the driver.
- `cost`: what a cell costs: the process of a command, records in the store, an episode of Push-T and its bytes.
- `requests`: the requests to an S3 server that shards and their commit make.
- `commit`: the commit of shards that 1,000 writers left, of which each has one episode.
- `limits`: what 1,000 workers do with these costs, as the table of `docs/ray.md`.

A real cluster of a head and three nodes (`ray.cluster_utils`); an S3 server on loopback where a store is measured.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")

import ray
from ray.cluster_utils import Cluster

import stable_worldmodel
from stable_worldmodel.ray import driver, worker

STORE = 78 << 20


def cluster(slots: int) -> Cluster:
    """A head and three nodes that share the slots."""
    each = {"object_store_memory": STORE, "include_dashboard": False}
    nodes = Cluster(initialize_head=True, head_node_args=each | {"num_cpus": slots - 3 * (slots // 4)})
    for _ in range(3):
        nodes.add_node(num_cpus=slots // 4, object_store_memory=STORE)
    ray.init(address=nodes.address, log_to_driver=False)
    return nodes


def run(folder: str, names: list[str]) -> tuple[dict, float]:
    """Runs cells without a command of their own through the driver; returns its summary and the seconds."""
    cells = [{"id": name, "name": name, "arguments": []} for name in names]
    driver.stages, driver.count = (lambda _: [cells]), (lambda _: len(cells))
    request = {"kind": "bench", "version": stable_worldmodel.__version__, "arguments": [], "output": folder, "folder": folder}
    began = time.monotonic()
    summary = driver.execute(request | {"directory": "/", "resources": {"cpu": 1}, "cells": {}})
    return summary, time.monotonic() - began


def sleeping(seconds: float) -> None:
    """Replaces the command of a cell by a sleep: the rest of a cell stays as it is."""

    def command(arguments: list[str], run: dict, state: object) -> None:
        time.sleep(seconds)

    worker._command = command


def cells() -> None:
    """200 cells of one second on four slots."""
    nodes = cluster(4)
    with tempfile.TemporaryDirectory() as folder:
        sleeping(0.0)
        run(f"{folder}/warm", [f"{index}" for index in range(16)])
        sleeping(1.0)
        summary, seconds = run(f"{folder}/run", [f"{index:06d}" for index in range(200)])
    print(f"{summary['ran']} cells of 1 s on 4 slots: {seconds:.1f} s, {20 * (seconds - 50):.0f} ms more per cell of a slot")
    ray.shutdown()
    nodes.shutdown()


def queue(number: int) -> None:
    """Cells in the queue of the driver."""
    nodes = cluster(4)
    sleeping(0.0)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    with tempfile.TemporaryDirectory() as folder:
        summary, seconds = run(folder, [f"{index:06d}" for index in range(number)])
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{summary['ran']} empty cells: {seconds:.0f} s, the driver at most {after:.0f} MiB ({before:.0f} MiB before)")
    ray.shutdown()
    nodes.shutdown()


def swm(*arguments: str) -> tuple[str, float]:
    """The output of a command, and its seconds."""
    began = time.monotonic()
    done = subprocess.run([sys.executable, "-m", "stable_worldmodel", *arguments], check=True, capture_output=True, text=True)
    return done.stdout, time.monotonic() - began


def cost() -> None:
    """What cells cost on this machine."""
    processes = sorted(swm("solvers")[1] for _ in range(7))
    print(f"the process of a command: {1000 * processes[3]:.0f} ms")
    with tempfile.TemporaryDirectory() as folder:
        path = f"{folder}/pusht.lance"
        episodes = 50
        _, seconds = swm("collect", "swm/PushT-v1", "-o", path, "--episodes", str(episodes), "--threads", "1")
        files = [file for file in Path(path).rglob("*") if file.is_file()]
        size = sum(file.stat().st_size for file in files)
        print(
            f"{episodes} episodes of Push-T at 224 px on one thread: {seconds:.1f} s, "
            f"{size / episodes / 1e6:.2f} MB an episode, {len(files)} files"
        )


def commit(writers: int) -> None:
    """The commit of one-episode shards."""
    with tempfile.TemporaryDirectory() as folder:
        path = f"{folder}/rooms.lance"
        options = ["collect", "swm/TwoRoom-v1", "-o", path, "--episodes", str(writers), "--no-pixels", "--max-steps", "5"]
        began = time.monotonic()
        for index in range(writers):
            swm(*options, "--policy", "random", "--envs", "1", "--shard", f"{index}/{writers}")
        wrote = time.monotonic() - began
        _, seconds = swm("datasets", "commit", path)
        episodes = json.loads(swm("inspect", path, "--json")[0])["episodes"]
        print(f"{writers} shards written in {wrote:.0f} s; their commit: {seconds:.1f} s, {episodes} episodes")


def requests(shards: int = 20) -> None:
    """What shards and their commit ask of an object store."""
    from collections import Counter
    from threading import Thread

    import boto3
    from moto.server import DomainDispatcherApplication, create_backend_app
    from werkzeug.serving import make_server

    application, counts = DomainDispatcherApplication(create_backend_app), Counter()

    def counted(environ: dict, start_response: object) -> object:
        counts[environ["REQUEST_METHOD"]] += 1
        return application(environ, start_response)

    server = make_server("127.0.0.1", 0, counted, threaded=True)
    Thread(target=server.serve_forever, daemon=True).start()
    store = {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{server.server_port}",
        "AWS_ACCESS_KEY_ID": "key",
        "AWS_REGION": "us-east-1",
    }
    os.environ.update(store | {"AWS_SECRET_ACCESS_KEY": "secret"})
    boto3.client("s3", endpoint_url=store["AWS_ENDPOINT_URL"]).create_bucket(Bucket="lab")

    def counting(what: str, number: int, *arguments: str) -> None:
        counts.clear()
        seconds = 0.0
        for index in range(number):
            seconds += swm(*arguments, *(["--shard", f"{index}/{number}", "--resume"] if number > 1 else []))[1]
        each = ", ".join(f"{count / number:.1f} {method}" for method, count in sorted(counts.items()))
        print(f"{what}: {each}, {seconds / number:.2f} s each")

    path = "s3://lab/rooms.lance"
    options = ["--episodes", str(shards), "--no-pixels", "--max-steps", "5", "--policy", "random", "--envs", "1"]
    counting("a shard", shards, "collect", "swm/TwoRoom-v1", "-o", path, *options)
    counting(f"the commit of {shards} shards", 1, "datasets", "commit", path)
    server.shutdown()


#: What the other parts measured, in seconds, bytes, requests and cells a second, and a store that answers a request in 20 ms.
COSTS = {
    "start": 0.12,
    "episode": 0.092,
    "bytes": 0.31e6,
    "shard_requests": 7,
    "records": 2,
    # One write in sequence, and ten reads and deletions of which 64 run at a time.
    "commit_requests": 1 + 10 / 64,
    "driver": 213,
    "latency": 0.02,
}


def limits(costs: dict[str, float]) -> None:
    """Prints what 1,000 workers do, computed from measured costs."""
    workers, shard, episodes = 1000, 50, 1_000_000
    seconds = costs["start"] + shard * costs["episode"] + (costs["shard_requests"] + costs["records"]) * costs["latency"]
    cells, shards = workers / seconds, episodes / shard
    rows = [
        ("a cell of 50 episodes", f"{seconds:.1f} s"),
        ("episodes an hour", f"{3600 * shard * cells:,.0f}"),
        ("cells a second (the driver can start)", f"{cells:.0f} ({costs['driver']:.0f})"),
        ("bytes to the store", f"{shard * cells * costs['bytes'] / 1e9:.2f} GB/s"),
        ("requests to the store", f"{cells * (costs['shard_requests'] + costs['records']):.0f} a second"),
        ("1,000,000 episodes are collected in", f"{shards / cells / 60:.0f} min"),
        (
            f"and their {shards:,.0f} shards committed in",
            f"{shards * costs['commit_requests'] * costs['latency'] / 60:.0f} min",
        ),
    ]
    for what, value in rows:
        print(f"| {what} | {value} |")


def main() -> None:
    """Runs the measurements that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", default=["cells", "queue", "cost", "requests", "commit"])
    parser.add_argument("--number", type=int, default=10_000, help="cells in the queue")
    parser.add_argument("--writers", type=int, default=1000, help="shards of the commit")
    for name, value in COSTS.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=float, default=value, help="a cost for `limits`")
    given = parser.parse_args()
    parts = {
        "cells": cells,
        "queue": lambda: queue(given.number),
        "cost": cost,
        "requests": requests,
        "commit": lambda: commit(given.writers),
        "limits": lambda: limits({name: getattr(given, name) for name in COSTS}),
    }
    for part in given.parts:
        parts[part]()


if __name__ == "__main__":
    main()
