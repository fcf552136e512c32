"""Tests of trainings by several processes of a Ray cluster, with Ray Train."""

import json
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

ray = pytest.importorskip("ray")
pytest.importorskip("ray.train.torch")

import stable_worldmodel as swm  # noqa: E402
from stable_worldmodel.ray.supply import RunRefused  # noqa: E402
from stable_worldmodel.train import train  # noqa: E402
from stable_worldmodel.wm._weights import read_safetensors  # noqa: E402

#: A large epsilon, because AdamW turns rounding errors of tiny gradients into steps.
SHORT = [
    "data.batch_size=12",
    "schedule.steps=6",
    "schedule.warmup=2",
    "optim.epsilon=1e-2",
    "log_every=2",
    "shards=1",
]


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "rooms.lance"
    world = swm.World("swm/TwoRoom-v1", num_envs=3, image_shape=(64, 64), max_episode_steps=25)
    world.collect(path, episodes=8, seed=0, progress=False, policy=swm.policy.RandomPolicy(seed=0))
    return str(path)


@pytest.fixture(scope="module", autouse=True)
def cluster():
    os.environ.update(RAY_USAGE_STATS_ENABLED="0", OMP_NUM_THREADS="1")
    ray.init(num_cpus=3, include_dashboard=False, object_store_memory=78 << 20, log_to_driver=False)
    yield
    ray.shutdown()


def weights(run):
    return read_safetensors(run / "checkpoint/weights.safetensors")


def log_of(run):
    return [json.loads(line) for line in (run / "train.jsonl").read_text().splitlines()]


def assert_close(found, expected, within=1e-3):
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        scale = np.abs(np.asarray(value)).max()
        assert np.abs(np.asarray(found[name]) - np.asarray(value)).max() <= within * max(scale, 0.1), name


def test_two_processes_train_what_one_trains(rooms, tmp_path):
    given = {"preset": "tiny", "device": "cpu"}
    train("pldm", rooms, out=str(tmp_path / "one"), settings=SHORT, **given)
    assert swm.ray.fit("pldm", rooms, tmp_path / "two", *SHORT, workers=2, **given) == str(tmp_path / "two")
    assert_close(weights(tmp_path / "two"), weights(tmp_path / "one"))
    for one, two in zip(log_of(tmp_path / "one"), log_of(tmp_path / "two"), strict=True):
        assert two["step"] == one["step"] and two["loss"] == pytest.approx(one["loss"], rel=1e-3)
    assert swm.wm.load(str(tmp_path / "two")).card["family"] == "pldm"


def test_a_killed_process_costs_time_only(rooms, tmp_path):
    given = {"preset": "tiny", "device": "cpu"}
    settings = [*SHORT[:1], "schedule.steps=120", *SHORT[2:], "save_every=10"]
    train("pldm", rooms, out=str(tmp_path / "one"), settings=settings, **given)
    run, killed = tmp_path / "two", []

    def kill():
        while not (run / "train.jsonl").exists() or len(log_of(run)) < 12:
            time.sleep(0.05)
        # The processes of Ray Train's group.
        found = subprocess.run(["pgrep", "-f", "ray::.*(RayTrainWorker|_RayTrainWorker)"], capture_output=True, text=True)
        killed.extend(int(pid) for pid in found.stdout.split()[:1])
        os.kill(killed[0], signal.SIGKILL)

    thread = threading.Thread(target=kill, daemon=True)
    thread.start()
    swm.ray.fit("pldm", rooms, run, *settings, workers=2, **given)
    assert killed
    # Lines of steps since the last checkpoint appear twice.
    found = {row["step"]: row["loss"] for row in log_of(run)}
    expected = {row["step"]: row["loss"] for row in log_of(tmp_path / "one")}
    assert found.keys() == expected.keys()
    assert found[120] == pytest.approx(expected[120], rel=0.05)


def test_what_is_wrong_is_refused_at_once(rooms, tmp_path):
    given = {"preset": "tiny", "device": "cpu"}
    with pytest.raises(ValueError, match="no.such.setting"):
        swm.ray.fit("gcbc", rooms, tmp_path / "a", "no.such.setting=1", workers=2, **given)
    with pytest.raises(RunRefused, match="9 processes take CPU=1 each, and the nodes have room for 3"):
        swm.ray.fit("gcbc", rooms, tmp_path / "b", *SHORT, workers=9, wait=1, **given)
    train("gcbc", rooms, out=str(tmp_path / "c"), settings=SHORT, **given)
    with pytest.raises(ValueError, match="holds a checkpoint; continue it with resume=true"):
        swm.ray.fit("gcbc", rooms, tmp_path / "c", *SHORT, workers=2, **given)
    command = [sys.executable, "-m", "stable_worldmodel.train", "gcbc", f"data={rooms}", "workers=-1"]
    assert "workers" in subprocess.run(command, capture_output=True, text=True).stderr
