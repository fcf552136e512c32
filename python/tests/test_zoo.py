"""Tests of capsules: checkpoints in one file, and those that come with the package."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import stable_worldmodel as swm

NAME = "zoo:two-room/pldm"


def costs(model):
    frames = np.random.default_rng(0).integers(0, 256, (2, 1, 64, 64, 3), np.uint8)
    candidates = np.zeros((2, 3, 2, 2 * model.action_block), np.float32)
    return model.get_cost({"pixels": frames, "goal": frames[::-1].copy()}, candidates)


def test_capsules_are_loaded_by_name_and_by_path(tmp_path, monkeypatch):
    model = swm.wm.load(NAME)
    assert model.card["family"] == "pldm" and model.card["env"] == "swm/TwoRoom-v1"
    path = tmp_path / "own" / "mine.safetensors"
    path.parent.mkdir()
    shutil.copy(model.path, path)
    copied = swm.wm.load(str(path))
    assert copied.card == model.card
    assert np.isfinite(costs(model)).all()
    np.testing.assert_array_equal(costs(copied), costs(model))
    monkeypatch.setenv("SWM_ZOO", str(tmp_path))
    assert Path(swm.wm.load("zoo:own/mine").path) == path


def test_capsule_plans_in_a_world():
    world = swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(64, 64), max_episode_steps=10)
    model = swm.wm.load(NAME)
    solver = swm.solver.CEMSolver(model, num_samples=8, n_steps=1, topk=2)
    config = swm.PlanConfig(horizon=2, receding_horizon=1, action_block=model.action_block)
    world.set_policy(swm.policy.MPCPolicy(solver, config=config))
    assert len(world.evaluate(episodes=2, seed=0)["episode_successes"]) == 2


def test_unknown_and_damaged_capsules_are_errors(tmp_path):
    with pytest.raises(FileNotFoundError, match="did you mean two-room/pldm"):
        swm.wm.load("zoo:two-room/pldn")
    damaged = tmp_path / "damaged.safetensors"
    damaged.write_bytes(Path(swm.wm.load(NAME).path).read_bytes()[:-1])
    with pytest.raises(Exception, match="damaged"):
        swm.wm.load(str(damaged))


def listed(folder, *paths):
    """The output of `swm zoo` of a new interpreter in a folder, with further folders of packages."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))}
    done = subprocess.run(
        [sys.executable, "-m", "stable_worldmodel", "zoo", "--json"],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return {capsule["name"]: Path(capsule["path"]) for capsule in json.loads(done.stdout)}


def test_data_wheel_is_found_in_another_folder_of_packages(tmp_path):
    """Systems may keep packages with and without compiled code apart (`lib64` and `lib`): it need not be beside the engine."""
    other, empty = tmp_path / "lib", tmp_path / "empty"
    path = other / "stable_worldmodel_zoo" / "maze" / "large.safetensors"
    path.parent.mkdir(parents=True)
    empty.mkdir()
    shutil.copy(swm.wm.load(NAME).path, path)
    # A folder without `__init__.py` is not the package.
    assert "maze/large" not in listed(empty, other)
    (other / "stable_worldmodel_zoo" / "__init__.py").touch()
    assert listed(empty, other)["maze/large"] == path
    assert "maze/large" not in listed(empty)
    # The current folder holds files of strangers: neither `python -m` nor `PYTHONPATH` makes its capsules those of the zoo.
    assert "maze/large" not in listed(other)
    assert "maze/large" not in listed(other, other)
