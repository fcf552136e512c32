"""Collections on a cluster have the bytes of one process, whatever dies."""

import os
import signal
import subprocess
import sys

import pytest
import ray
from conftest import add_node, content_hash, printed, swm, until

import stable_worldmodel.ray as swm_ray
from stable_worldmodel.ray.folder import Folder


def test_a_collection_in_an_object_store_has_the_hash_of_one_process(cluster, s3, rooms):
    path, options, _ = rooms
    output = f"{s3}/rooms.lance"
    done = swm_ray.collect("swm/TwoRoom-v1", output, shards=5, **options)
    summary = ray.get(done)
    assert (summary["output"], summary["cells"], summary["ran"]) == (output, 6, 6)
    assert content_hash(output) == content_hash(path)
    assert swm_ray.progress(summary["folder"]) == {"done": 6, "cells": 6}
    # The same call again finds everything done.
    again = ray.get(swm_ray.collect("swm/TwoRoom-v1", output, shards=5, **options))
    assert again["ran"] == 0
    # Another collection is no continuation.
    with pytest.raises(ray.exceptions.RayTaskError, match="has another run: its arguments"):
        ray.get(swm_ray.collect("swm/TwoRoom-v1", output, shards=5, **(options | {"seed": 6})))


def test_a_node_that_is_killed_changes_nothing(cluster, s3, rooms):
    path, options, _ = rooms
    output, folder = f"{s3}/killed.lance", Folder(f"{s3}/killed.lance.ray")
    doomed = add_node(cluster)
    done = swm_ray.collect("swm/TwoRoom-v1", output, shards=12, **options)
    # It has done some cells, and does another one.
    until(lambda: any(doomed.node_id[:8] in folder.read_json(name)["node"] for name in cells(folder)))
    cluster.remove_node(doomed, allow_graceful=False)
    assert ray.get(done)["cells"] == 13
    assert content_hash(output) == content_hash(path)


def cells(folder):
    """The records of a run."""
    return [f"cells/{name}" for name in folder.list("cells")]


def test_a_driver_that_is_killed_and_started_again_continues(cluster, s3, rooms):
    path, _, flags = rooms
    output, folder = f"{s3}/driver.lance", Folder(f"{s3}/driver.lance.ray")
    command = [sys.executable, "-m", "stable_worldmodel", "collect", "swm/TwoRoom-v1", "-o", output, "--on", "ray"]
    command += [*map(str, flags), "--shards", "8"]
    first = subprocess.Popen(command, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    until(lambda: len(cells(folder)) >= 2)
    os.killpg(first.pid, signal.SIGKILL)
    first.wait()
    # Another machine may continue: the folder is all that is needed.
    rest = subprocess.run(
        [sys.executable, "-m", "stable_worldmodel.ray", folder.root, "--trust", "--json"], capture_output=True, text=True
    )
    assert rest.returncode == 0, rest.stderr
    assert '"cells": 9' in rest.stdout and '"ran": 9' not in rest.stdout
    assert content_hash(output) == content_hash(path)


def test_a_conversion_has_the_bytes_of_its_source(cluster, s3, rooms):
    path, *_ = rooms
    output = f"{s3}/png.lance"
    assert ray.get(swm_ray.convert(path, output, codec="png", shards=4))["cells"] == 6
    assert printed("inspect", output)["episodes"] == 24
    assert content_hash(output) == content_hash(path)


def test_cancelling_the_reference_ends_the_run(cluster, s3, rooms):
    _, options, _ = rooms
    folder = Folder(f"{s3}/cancelled.lance.ray")
    done = swm_ray.collect("swm/TwoRoom-v1", f"{s3}/cancelled.lance", shards=24, **options)
    until(lambda: cells(folder))
    ray.cancel(done)
    with pytest.raises((ray.exceptions.TaskCancelledError, ray.exceptions.RayTaskError)):
        ray.get(done)
    assert 0 < len(cells(folder)) < 25


def test_the_command_line_refuses_what_several_machines_cannot_write(tmp_path):
    done = swm("collect", "swm/TwoRoom-v1", "-o", tmp_path / "rooms.h5", "--on", "ray")
    assert done.returncode == 2 and "Lance datasets only" in done.stderr
    done = swm("collect", "swm/TwoRoom-v1", "-o", tmp_path / "rooms.lance", "--on", "slurm")
    assert done.returncode == 2 and "write ray, or ray://HOST:PORT" in done.stderr
    done = swm("collect", "swm/TwoRoom-v1", "-o", tmp_path / "rooms.lance", "--on", "ray", SWM_RAY_PYTHON="/usr/bin/python3")
    assert done.returncode == 2 and "it has no package ray" in done.stderr and "stable-worldmodel-rs[ray]" in done.stderr
