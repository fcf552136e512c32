"""A real Ray cluster on this machine, and a real S3 server on loopback."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

# Ray's nodes and the processes of cells inherit these.
os.environ.update(
    AWS_ACCESS_KEY_ID="key",
    AWS_SECRET_ACCESS_KEY="secret",
    AWS_REGION="us-east-1",
    RAY_USAGE_STATS_ENABLED="0",
    RAY_DEDUP_LOGS="0",
    RAY_raylet_start_wait_time_s="120",
    # A worker process takes a second to start: those of one run serve the next one.
    RAY_num_workers_soft_limit="4",
    # Jobs run the first `python` of the path.
    PATH=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
)

import ray
from ray.cluster_utils import Cluster

#: The smallest object store of a node, in bytes: nothing large passes through Ray.
STORE = 78 << 20


@pytest.fixture(scope="session")
def s3():
    """The URI of a bucket."""
    import boto3
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    os.environ["AWS_ENDPOINT_URL"] = f"http://{host}:{port}"
    boto3.client("s3", endpoint_url=os.environ["AWS_ENDPOINT_URL"]).create_bucket(Bucket="lab")
    yield "s3://lab"
    server.stop()


@pytest.fixture(scope="session")
def cluster(s3, tmp_path_factory):
    """A head and two more nodes of one CPU each; this process has joined them."""
    os.environ["STABLEWM_HOME"] = str(tmp_path_factory.mktemp("home"))
    head = {"num_cpus": 1, "object_store_memory": STORE, "include_dashboard": True, "dashboard_port": 0}
    # Another cluster of this machine may have Ray's own port.
    head["dashboard_agent_listen_port"] = 0
    nodes = Cluster(initialize_head=True, head_node_args=head)
    for _ in range(2):
        add_node(nodes)
    ray.init(address=nodes.address, log_to_driver=False)
    os.environ["RAY_ADDRESS"] = nodes.address
    yield nodes
    ray.shutdown()
    nodes.shutdown()


def add_node(cluster: Cluster, **options):
    """Adds a node of one CPU."""
    return cluster.add_node(**{"num_cpus": 1, "object_store_memory": STORE, **options})


def until(condition, seconds=120):
    """Waits for a condition of the cluster."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "the condition was not met"
        time.sleep(0.05)


def swm(*arguments, **environment) -> subprocess.CompletedProcess:
    """Runs the command line of the wheel."""
    command = [sys.executable, "-m", "stable_worldmodel", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env={**os.environ, **environment})


def printed(*arguments):
    """What a command prints as JSON; it must succeed."""
    done = swm(*arguments, "--json")
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def content_hash(dataset: str | Path) -> str:
    """The hash of what a dataset contains."""
    return printed("inspect", dataset, "--checksum")["checksum"]


@pytest.fixture(scope="session")
def rooms(tmp_path_factory, s3):
    """A dataset that one process collected, and the arguments of its command."""
    path = tmp_path_factory.mktemp("rooms") / "rooms.lance"
    options = {"episodes": 24, "seed": 5, "image": 64, "policy": "random", "max_steps": 30}
    flags = [part for name, value in options.items() for part in (f"--{name.replace('_', '-')}", value)]
    printed("collect", "swm/TwoRoom-v1", "--output", path, *flags)
    return path, options, flags


def files_of(study):
    """The files of a study on this machine, without those that begin with a dot."""
    files = {path.relative_to(study).as_posix(): path.read_bytes() for path in study.rglob("*") if path.is_file()}
    return {name: content for name, content in files.items() if not name.startswith(".")}


def remove(location):
    """Removes an object of the store."""
    import boto3

    bucket, key = location.removeprefix("s3://").split("/", 1)
    boto3.client("s3", endpoint_url=os.environ["AWS_ENDPOINT_URL"]).delete_object(Bucket=bucket, Key=key)
