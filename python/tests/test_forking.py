"""Environments and writers in processes that were forked after they were made, and Gymnasium environments in threads."""

import json
import os
import subprocess
import sys
import threading

import numpy as np
import pytest

from stable_worldmodel import World, data, policy
from stable_worldmodel._lazy import lazy

#: A Gymnasium environment, and one whose step uses another world, registered when their module is imported.
COUNTING = """
import gymnasium
import numpy as np


class Counting(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), 0.0, False, False, {}

    def render(self):
        return np.zeros((32, 32, 3), np.uint8)


class Nested(Counting):
    inner = None

    def step(self, action):
        if Nested.inner is not None:
            Nested.inner.step()
        return super().step(action)


gymnasium.register("Counting-v0", Counting, max_episode_steps=5)
gymnasium.register("Nested-v0", Nested, max_episode_steps=5)
"""


def run(tmp_path, text):
    """The JSON that a program prints; a program that hangs fails the test."""
    (tmp_path / "counting.py").write_text(COUNTING)
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run([sys.executable, "-c", text], cwd=tmp_path, env=env, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "panicked" not in done.stderr, done.stderr
    return json.loads(done.stdout.strip().splitlines()[-1])


def in_fork(work):
    """What `work` prints in a forked process, which ends as Python does: with the destructors of its objects."""
    return f"""
import json, os, sys
read, write = os.pipe()
child = os.fork()
if child == 0:
    try:
        {work}
        said = "no error"
    except ValueError as error:
        said = str(error)
    os.write(write, said.encode())
    os.close(write)
    sys.exit(0)
os.close(write)
with os.fdopen(read) as pipe:
    said = pipe.read()
status = os.waitpid(child, 0)[1]
"""


def test_world_of_the_parent_cannot_be_used_in_a_forked_process(tmp_path):
    text = f"""
from stable_worldmodel import World
world = World("swm/TwoRoom-v1", num_envs=4)
world.reset(seed=0)
{in_fork("world.reset(seed=1)")}
world.reset(seed=1)
print(json.dumps([said, status]))
"""
    said, status = run(tmp_path, text)
    assert status == 0 and "before this process was forked" in said, said


@pytest.mark.parametrize("name", ["d.lance", "d.h5", "d-folder"])
def test_writer_of_the_parent_cannot_be_used_in_a_forked_process(tmp_path, name):
    text = f"""
import numpy as np
from stable_worldmodel import data
rows = {{"state": np.zeros((3, 2), np.float32), "action": np.zeros((2, 1), np.float32)}}
writer = data.EpisodeWriter({str(tmp_path / name)!r}, format={"folder" if name == "d-folder" else None!r})
writer.write_episode(rows)
{in_fork("writer.write_episode(rows)")}
writer.write_episode(rows)
writer.close()
print(json.dumps([said, status, data.load_dataset({str(tmp_path / name)!r}).num_episodes]))
"""
    said, status, episodes = run(tmp_path, text)
    assert status == 0 and "before this process was forked" in said, said
    assert episodes == 2


@pytest.mark.parametrize("end", ["lance", "h5", "folder", "video", "lerobot"])
def test_new_writers_work_in_a_forked_process(tmp_path, end):
    text = f"""
import numpy as np
from stable_worldmodel import data
rows = {{"state": np.zeros((3, 2), np.float32), "pixels": np.zeros((3, 16, 16, 3), np.uint8)}}
rows["action"] = np.zeros((2, 1), np.float32)
def written(name):
    with data.open_writer(name, format={end!r} if {end!r} in ("folder", "video", "lerobot") else None) as writer:
        writer.write_episodes([rows] * 4)
    return name
def all_ways():
    data.convert(written("child.{end}"), "converted.lance", progress=False)
    data.merge(["child.{end}", "converted.lance"], "merged.lance", progress=False)
    buffer = data.ReplayBuffer(100)
    buffer.write_episode(rows)
    buffer.dump("dumped.{end if end in ("lance", "h5") else "lance"}")
data.load_dataset(written("parent.{end}")).get_col_data("pixels")
{in_fork("all_ways()")}
names = ["child.{end}", "converted.lance", "merged.lance"]
print(json.dumps([said, status, [data.load_dataset(name).num_episodes for name in names]]))
"""
    assert run(tmp_path, text) == ["no error", 0, [4, 4, 8]]


@pytest.mark.parametrize(("threads", "words"), [(1, "no error"), (2, "threads=1 or workers=True")])
def test_gymnasium_world_inside_the_step_of_another(tmp_path, threads, words):
    text = f"""
import json
import counting
import stable_worldmodel as swm
outer, inner = swm.World("Nested-v0", num_envs=4), swm.World("Counting-v0", num_envs=2, threads={threads})
for world in (inner, outer):
    world.set_policy(swm.policy.RandomPolicy())
    world.reset(seed=0)
said = "no error"
counting.Nested.inner = inner
try:
    outer.step()
except Exception as error:
    said = str(error)
print(json.dumps(said))
"""
    assert words in run(tmp_path, text)


def test_threads_make_the_first_gymnasium_world_at_once(tmp_path):
    text = """
import json, threading
import counting
from stable_worldmodel import World
start, failed, made = threading.Barrier(8), [], []
def make():
    start.wait()
    try:
        made.append(World("Counting-v0", num_envs=1))
    except Exception as error:
        failed.append(repr(error))
threads = [threading.Thread(target=make) for _ in range(8)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
print(json.dumps([failed, len(made)]))
"""
    assert run(tmp_path, text) == [[], 8]


def test_columns_with_the_names_of_numbers_are_not_left_out_silently(tmp_path):
    rows = {"state": np.zeros((3, 2), np.float32), "action": np.zeros((2, 1), np.float32)}
    with data.open_writer(tmp_path / "d.lance") as writer:
        writer.write_episode({**rows, "step_idx": np.array([7, 8, 9]), "episode_idx": [4, 4, 4]})
        for name, values in (("step_idx", [0, 5, 10]), ("episode_idx", [0, 1, 2]), ("step_idx", ["a", "b", "c"])):
            with pytest.raises(ValueError, match=f"column '{name}': its values would be lost"):
                writer.write_episode({**rows, name: values})
    assert data.load_dataset(tmp_path / "d.lance").num_episodes == 1


def test_wrong_starts_and_factors_have_clear_errors(tmp_path):
    world = World("swm/TwoRoom-v1", num_envs=1)
    world.set_policy(policy.ExpertPolicy())
    world.collect(tmp_path / "d.lance", episodes=2, seed=0, progress=False)
    for episodes, steps, words in (
        ([0, 1], [0], "2 and 1 values"),
        ([0], [-1], "start_steps"),
        ([0.5], [0], "episodes_idx"),
        (3, [0], "episodes_idx"),
        (["a"], [0], "episodes_idx"),
        ([0], [float("nan")], "start_steps"),
        ([0], [1 << 63], "start_steps"),
        ([], [], "they are empty"),
        ([0], [1 << 60], "its goal"),
        ([9], [0], "episode 9"),
    ):
        with pytest.raises((ValueError, IndexError), match=words):
            world.evaluate(dataset=tmp_path / "d.lance", episodes_idx=episodes, start_steps=steps)
    for value in (float("nan"), [0.5, float("inf")], "red"):
        with pytest.raises(ValueError, match=r"options\['variation_values'\]\['agent.speed'\]: expected"):
            world.reset(seed=0, options={"variation_values": {"agent.speed": value}})
    with pytest.raises(ValueError, match=r"options\['state'\]: expected finite numbers"):
        world.reset(seed=0, options={"state": [float("nan")] * 4})


def test_attributes_of_other_objects_do_not_wait():
    class Slow:
        @lazy
        def value(self):
            begun.set()
            done.wait(30)
            return 1

    class Fast(Slow):
        @lazy
        def other(self):
            return 2

    begun, done = threading.Event(), threading.Event()
    thread = threading.Thread(target=lambda: Slow().value)
    thread.start()
    begun.wait(30)
    fast = Fast()
    assert (fast.other, vars(fast)) == (2, {"other": 2}) and thread.is_alive()
    done.set()
    thread.join()
    assert fast.value == 1
