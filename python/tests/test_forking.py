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


#: Holds `lock` in another thread while the process forks. The child process ends if it waits for the lock.
HOLDING = """
import json, os, signal, sys, threading
import numpy as np
from stable_worldmodel import World, _gym, data
from stable_worldmodel._forks import fork_lock
from stable_worldmodel.data.foreign import _Rows
rows = {{"state": np.zeros((3, 2), np.float32), "action": np.zeros((2, 1), np.float32)}}
{prepare}
held, done = threading.Event(), threading.Event()
def hold():
    with lock:
        held.set()
        done.wait()
thread = threading.Thread(target=hold)
thread.start()
held.wait()
{fork}
done.set()
thread.join()
{after}
print(json.dumps([said, status]))
"""


@pytest.mark.parametrize(
    ("prepare", "work", "after"),
    [
        ("lock = fork_lock()", "lock.acquire()", "lock.acquire()"),
        (
            "buffer = data.ReplayBuffer(100); buffer.write_episode(rows); lock = buffer._lock",
            "buffer.sample(2); buffer.write_episode(rows); assert buffer.num_episodes == 2",
            "buffer.sample(2); assert buffer.num_episodes == 1",
        ),
        (
            "buffer = data.ReplayBuffer(100); buffer.write_episode(rows); reader = _Rows(buffer); lock = reader._lock",
            "assert reader.rows('state', 0, 0, 3).shape == (3, 2)",
            "assert reader.rows('state', 0, 0, 3).shape == (3, 2)",
        ),
        # Python lists a module whose code runs in the other thread.
        (
            "import counting, types; lock = _gym._LOADING; sys.modules['swm_bridge'] = types.ModuleType('swm_bridge')",
            "World('Counting-v0', num_envs=1).reset(seed=0)",
            "assert not vars(sys.modules['swm_bridge']).get('Bridge')",
        ),
    ],
    ids=["lock", "buffer", "reader", "bridge"],
)
def test_forked_processes_can_take_the_locks_that_another_thread_held(tmp_path, prepare, work, after):
    text = HOLDING.format(prepare=prepare, fork=in_fork(f"signal.alarm(30); {work}"), after=after)
    assert run(tmp_path, text) == ["no error", 0]


def test_forked_processes_cannot_use_a_writer_with_which_another_thread_wrote(tmp_path):
    prepare = "writer = data.EpisodeWriter('d.lance'); writer.write_episode(rows); lock = writer._lock"
    after = "writer.write_episode(rows); writer.close(); assert data.load_dataset('d.lance').num_episodes == 2"
    for work in ("writer.write_episode(rows)", "writer.close()"):
        text = HOLDING.format(prepare=prepare, fork=in_fork(f"signal.alarm(30); {work}"), after=after)
        (tmp_path / work[:12]).mkdir()
        said, status = run(tmp_path / work[:12], text)
        assert status == 0 and "before this process was forked" in said, said


def test_thread_that_forks_keeps_its_lock(tmp_path):
    text = f"""
import threading
from stable_worldmodel._forks import fork_lock
lock = fork_lock()
def is_free():
    found = []
    thread = threading.Thread(target=lambda: found.append(lock.acquire(blocking=False)))
    thread.start()
    thread.join()
    return found[0]
def check():
    if is_free():
        raise ValueError("the lock is free")
    lock.release()
    if not is_free():
        raise ValueError("the lock is not free")
lock.acquire()
{in_fork("check()")}
print(json.dumps([said, status]))
"""
    assert run(tmp_path, text) == ["no error", 0]


def test_forked_process_plays_while_another_thread_of_its_parent_is_in_a_step(tmp_path):
    text = f"""
import signal, threading
import counting
from stable_worldmodel import World, policy
def play(name):
    world = World(name, num_envs=1)
    world.set_policy(policy.RandomPolicy())
    world.reset(seed=0)
    world.step()
class Waiting:
    def step(self):
        begun.set()
        done.wait()
begun, done = threading.Event(), threading.Event()
counting.Nested.inner = Waiting()
thread = threading.Thread(target=play, args=["Nested-v0"])
thread.start()
begun.wait()
{in_fork("signal.alarm(30); play('Counting-v0')")}
done.set()
thread.join()
play("Counting-v0")
print(json.dumps([said, status]))
"""
    assert run(tmp_path, text) == ["no error", 0]


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
        writer.write_episode({**rows, "episode_idx": np.full((3, 1), 4), "step_idx": np.array([[7], [8], [9]])})
        for name, values in (
            ("step_idx", [0, 5, 10]),
            ("step_idx", [[0, 1], [2, 3], [4, 5]]),
            ("step_idx", ["a", "b", "c"]),
            ("episode_idx", [0, 1, 2]),
            ("episode_idx", np.full((3, 2), 4)),
        ):
            with pytest.raises(ValueError, match=f"column '{name}': its values would be lost"):
                writer.write_episode({**rows, name: values})
    assert data.load_dataset(tmp_path / "d.lance").num_episodes == 2


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
    given = {"dataset": tmp_path / "d.lance", "episodes_idx": [0], "start_steps": [1], "goal_offset": 1, "eval_budget": 1}
    with pytest.raises(ValueError, match="episodes: 3; expected 1, the length of episodes_idx"):
        world.evaluate(episodes=3, **given)
    for episodes in (None, 1):
        assert len(world.evaluate(episodes=episodes, floor=False, progress=False, **given)["steps"]) == 1
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
