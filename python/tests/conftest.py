"""Gives every test its own home folder, so that tests do not find the datasets and checkpoints of the user."""

import os
import signal
from pathlib import Path

import pytest

import stable_worldmodel as swm

# A shell ignores SIGINT in background jobs; the programs that tests start must receive it.
signal.signal(signal.SIGINT, signal.default_int_handler)

#: The folder of `swm assets`, which is not in a test's home.
ASSETS = Path(os.environ.get("STABLEWM_HOME") or Path.home() / ".stable_worldmodel") / "assets"


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("SWM_ASSETS", os.environ.get("SWM_ASSETS") or str(ASSETS))
    monkeypatch.setenv("STABLEWM_HOME", str(tmp_path / "home"))
    return tmp_path / "home"


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    """A dataset of 12 episodes of Two-Room at 64 px; modules that need another one define their own."""
    path = tmp_path_factory.mktemp("data") / "rooms.lance"
    world = swm.World("swm/TwoRoom-v1", num_envs=3, image_shape=(64, 64), max_episode_steps=25)
    world.collect(path, episodes=12, seed=0, progress=False, policy=swm.policy.RandomPolicy(seed=0))
    return str(path)
