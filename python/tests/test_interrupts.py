"""Tests of failures during long runs: the original error is raised, and finished work is stored."""

import os
import signal
import subprocess
import sys
import time

import gymnasium
import numpy as np
import pytest

import stable_worldmodel as swm


class Broken(Exception):
    pass


class Fragile(gymnasium.Env):
    """An environment that counts steps and raises from the episode and step `breaks` on."""

    metadata = {"render_modes": ["rgb_array"]}

    def __init__(self, render_mode=None):
        self.render_mode = render_mode
        self.observation_space = gymnasium.spaces.Box(0, 1000, (1,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
        self.episodes, self.breaks = 0, None

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count, self.episodes = 0, self.episodes + 1
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.count += 1
        if self.breaks is not None and (self.episodes, self.count) >= self.breaks:
            raise Broken(f"episode {self.episodes}, step {self.count}")
        return np.full(1, self.count, np.float32), 1.0, False, self.count == 5, {}

    def render(self):
        return np.full((8, 8, 3), self.count, np.uint8)


@pytest.fixture
def world():
    gymnasium.register("Fragile-v0", entry_point=Fragile, max_episode_steps=5)
    world = swm.World("Fragile-v0", num_envs=2, image_shape=(8, 8))
    world.set_policy(swm.policy.RandomPolicy(seed=0))
    yield world
    world.close()
    gymnasium.registry.pop("Fragile-v0")


def test_error_of_an_environment_step_is_raised(world):
    world.reset(seed=0)
    fragile = world.gym_envs[1].unwrapped
    fragile.breaks = (fragile.episodes, 3)
    with pytest.raises(Broken, match="step 3") as caught:
        for _ in range(5):
            world.step()
    # The traceback contains the environment's `step`.
    assert any(entry.name == "step" and "test_interrupts" in str(entry.path) for entry in caught.traceback)
    fragile.breaks = None
    world.reset(seed=1)
    assert (world.infos["observation"] == 0).all()
    for _ in range(5):
        world.step()
    assert world.truncateds.all() and (world.infos["observation"] == 5).all()


def test_finished_episodes_are_stored_after_an_error(world, tmp_path):
    fragile = world.gym_envs[0].unwrapped
    fragile.breaks = (fragile.episodes + 4, 3)
    with pytest.raises(Broken):
        world.collect(tmp_path / "d.lance", episodes=50, seed=0, progress=False)
    data = swm.data.load_dataset(str(tmp_path / "d.lance"), backend="numpy")
    begun = data.num_episodes
    assert begun >= 4 and set(np.asarray(data.lengths).tolist()) == {6}
    # Collection resumes after the stored episodes.
    fragile.breaks = None
    outcome = world.collect(tmp_path / "d.lance", episodes=10, seed=0, mode="resume", progress=False)
    assert outcome == {"episodes": 10, "added": 10 - begun, "steps": 5 * (10 - begun)}


def test_world_is_usable_after_a_failed_evaluation(world):
    fragile = world.gym_envs[0].unwrapped
    fragile.breaks = (fragile.episodes + 1, 2)
    with pytest.raises(Broken):
        world.evaluate(episodes=4, seed=0, progress=False)
    fragile.breaks = None
    assert world.evaluate(episodes=4, seed=0, progress=False)["steps"].tolist() == [5] * 4


CTRL_C = """
import sys
import stable_worldmodel as swm
world = swm.World("swm/PushT-v1", num_envs=2, image_shape=(32, 32), max_episode_steps=100)
world.set_policy(swm.policy.ExpertPolicy() if sys.argv[1] == "engine" else type("Mine", (swm.policy.BasePolicy,), {
    "get_action": lambda self, infos: self.env.action_space.sample()})())
print("ready", flush=True)
try:
    world.evaluate(episodes=1_000_000, seed=0, progress=False)
except KeyboardInterrupt:
    world.reset(seed=0)
    world.step()
    print("interrupted", flush=True)
"""


@pytest.mark.parametrize("policy", ["engine", "python"])
def test_ctrl_c_stops_an_evaluation(policy):
    child = subprocess.Popen([sys.executable, "-c", CTRL_C, policy], stdout=subprocess.PIPE, text=True)
    try:
        assert child.stdout.readline().strip() == "ready"
        time.sleep(0.5)
        os.kill(child.pid, signal.SIGINT)
        assert child.communicate(timeout=10)[0].strip() == "interrupted" and child.returncode == 0
    finally:
        child.kill()


#: A search that takes hours, with a callback that says when it has begun.
LONG_PLAN = """
import sys
import gymnasium
import numpy as np
import stable_worldmodel as swm
from stable_worldmodel.planning.solver.callbacks import Callback

class Begun(Callback):
    def compute(self, step, **state):
        if step == 0:
            print("ready", flush=True)

class Mine:
    def get_cost(self, infos, candidates):
        return (candidates ** 2).sum((2, 3))

model = Mine() if sys.argv[1] == "python" else "simulator"
solver = swm.solver.CEMSolver(model, n_steps=10_000, num_samples=5_000, callbacks=[Begun()])
try:
    if sys.argv[2] == "world":
        world = swm.World("swm/PushT-v1", num_envs=2, image_shape=(32, 32))
        world.set_policy(swm.policy.MPCPolicy(solver, swm.PlanConfig(10, 10)))
        world.reset(seed=0)
        if sys.argv[1] == "python":
            world.evaluate(episodes=2, seed=0, progress=False)
        else:
            world.step()
    else:
        space = gymnasium.spaces.Box(-1, 1, (2, 2), np.float32)
        solver.configure(action_space=space, n_envs=2, config=swm.PlanConfig(10, 10))
        solver.solve({"state": np.zeros((2, 1, 2), np.float32)})
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


@pytest.mark.parametrize(("model", "caller"), [("simulator", "world"), ("python", "world"), ("python", "solve")])
def test_ctrl_c_stops_a_search(model, caller):
    pytest.importorskip("torch")
    child = subprocess.Popen([sys.executable, "-c", LONG_PLAN, model, caller], stdout=subprocess.PIPE, text=True)
    try:
        assert child.stdout.readline().strip() == "ready"
        os.kill(child.pid, signal.SIGINT)
        assert child.communicate(timeout=20)[0].strip() == "interrupted" and child.returncode == 0
    finally:
        child.kill()


# Environments in worker processes.


def children(pid):
    found = []
    for task in os.listdir(f"/proc/{pid}/task"):
        try:
            with open(f"/proc/{pid}/task/{task}/children") as listed:
                found += [int(child) for child in listed.read().split()]
        except (FileNotFoundError, ProcessLookupError):
            pass  # the thread ended after it was listed
    return found


def gone(pids, seconds=10):
    """Whether the processes end within `seconds`."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        if not any(os.path.exists(f"/proc/{pid}") for pid in pids):
            return True
        time.sleep(0.05)
    return False


@pytest.fixture
def unrendered(monkeypatch):
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def carts(**more):
    world = swm.World("CartPole-v1", num_envs=2, image_shape=(24, 24), **more)
    world.set_policy(swm.policy.RandomPolicy(seed=0))
    world.reset(seed=0)
    return world


def test_environments_of_this_process_run_one_at_a_time(unrendered):
    def frames():
        world = carts()
        frames = []
        for _ in range(6):
            world.step()
            frames.append(np.array(world.infos["pixels"]))
        return np.stack(frames)

    # pygame draws other pixels if two threads use it at a time.
    first = frames()
    assert all(np.array_equal(first, frames()) for _ in range(12))


def test_killed_worker_is_replaced_during_an_episode(unrendered):
    before = set(children(os.getpid()))
    local, remote = carts(), carts(workers=True)
    workers = set(children(os.getpid())) - before
    assert len(workers) == 2
    for step in range(6):
        if step == 3:
            os.kill(min(workers), signal.SIGKILL)
        for world in (local, remote):
            world.step()
        assert np.array_equal(local.infos["observation"], remote.infos["observation"])
        assert np.array_equal(local.infos["pixels"], remote.infos["pixels"])
    workers = set(children(os.getpid())) - before
    remote.close()
    assert gone(workers)
    with pytest.raises(RuntimeError, match="closed"):
        remote.step()
    remote.close()


ABANDONED = """
import time
import stable_worldmodel as swm
world = swm.World("CartPole-v1", num_envs=2, image_shape=(24, 24), workers=True)
world.set_policy(swm.policy.RandomPolicy(seed=0))
print("ready", flush=True)
world.evaluate(episodes=1_000_000, progress=False)
"""


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_workers_end_with_the_program(unrendered, end):
    child = subprocess.Popen([sys.executable, "-c", ABANDONED], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert child.stdout.readline().strip() == "ready"
    workers = children(child.pid)
    assert len(workers) == 2
    time.sleep(0.2)
    os.kill(child.pid, end)
    assert child.wait(timeout=10) == -end
    assert gone(workers)


# Training.

TRAINING = """
import sys
import stable_worldmodel as swm
world = swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(64, 64), max_episode_steps=30)
world.set_policy(swm.policy.RandomPolicy(seed=0))
world.collect("rooms", episodes=8, seed=0, progress=False)
small = {"data": "rooms", "preset": "tiny", "data__batch_size": 8}
swm.wm.train("lewm", out="short", schedule__steps=1, **small)
print("ready", flush=True)
try:
    swm.wm.train("lewm", out="long", schedule__steps=1_000_000, **small)
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL])
def test_interrupted_training_saves_a_checkpoint(end, home):
    child = subprocess.Popen([sys.executable, "-c", TRAINING], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert child.stdout.readline().strip() == "ready"
    time.sleep(1.0)
    workers = children(child.pid)
    assert len(workers) == 1
    os.kill(child.pid, end)
    output = child.communicate(timeout=20)[0].strip()
    assert output == ("interrupted" if end == signal.SIGINT else "") and gone(workers)
    assert (home / "checkpoints/long/checkpoint/weights.safetensors").exists()


def test_training_reports_wrong_arguments():
    with pytest.raises(ValueError, match="unknown dataset 'nothing'"):
        swm.wm.train("lewm", data="nothing", out="mine")
    with pytest.raises(ValueError, match="schedule.steps"):
        swm.wm.train("lewm", data="nothing", out="mine", schedul__steps=3)


@pytest.mark.parametrize("play", ["collect(writer=swm.data.ReplayBuffer(100), episodes=10**6", "evaluate(episodes=10**6"])
def test_program_ends_silently_while_a_thread_plays(play):
    program = f"""
import threading, time
import stable_worldmodel as swm
world = swm.World("swm/TwoRoom-v1", num_envs=2, add_pixels=False, max_episode_steps=25)
world.set_policy(swm.policy.RandomPolicy(seed=0))
threading.Thread(target=lambda: world.{play}, progress=False), daemon=True).start()
"""
    for _ in range(3):
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
        assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("env", ["swm/TwoRoom-v1", "CartPole-v1"])
def test_program_ends_silently_while_a_thread_calls_python_from_the_engine(env, tmp_path):
    # torch, which is half imported when the interpreter ends, would print errors of its own.
    program = """
import sys, threading, time
sys.modules["torch"] = None
import numpy as np
import stable_worldmodel as swm

class Model:
    backend = "numpy"

    def get_cost(self, infos, candidates):
        return (candidates ** 2).sum((-1, -2))

def play():
    world = swm.World(sys.argv[1], 2, image_shape=(32, 32), max_episode_steps=20, image_transform=lambda frame: frame)
    if sys.argv[1] == "CartPole-v1":
        world.set_policy(swm.policy.RandomPolicy(0))
    else:
        world.set_policy(swm.policy.MPCPolicy(swm.solver.CEMSolver(Model(), num_samples=64, n_steps=5, topk=8)))
    world.collect(writer=swm.data.ReplayBuffer(10_000), episodes=10**7, progress=False)

threading.Thread(target=play, daemon=True).start()
time.sleep(float(sys.argv[2]))
"""
    for tenth in range(6):
        command = [sys.executable, "-c", program, env, str(tenth / 10)]
        # Without a folder for sockets, SDL prints an error.
        variables = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)}
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, env=variables)
        assert (done.returncode, done.stderr) == (0, "")


def test_program_ends_while_a_policy_outlasts_it():
    # The policy wakes up after the five seconds that the end of the interpreter waits, while Python deletes its modules.
    program = """
import sys, threading, time
import stable_worldmodel as swm

class Slow:
    def __del__(self, sleep=time.sleep):
        sleep(3)

class Policy(swm.policy.BasePolicy):
    def get_action(self, infos):
        playing.set()
        time.sleep(6.5)
        return self.env.action_space.sample()

def play():
    world = swm.World("swm/TwoRoom-v1", 2, image_shape=(32, 32), max_episode_steps=20)
    world.set_policy(Policy())
    world.collect(writer=swm.data.ReplayBuffer(10_000), episodes=10, progress=False)

sys.slow, playing = Slow(), threading.Event()
threading.Thread(target=play, daemon=True).start()
playing.wait()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


def test_engine_is_not_loaded_after_the_end_of_the_program():
    # The first function that was registered runs last.
    program = """
import atexit, threading, time

@atexit.register
def wait():
    ending.set()
    ended.wait()
    print("thread", "loaded" if loaded else "ended")

import stable_worldmodel as swm

def play():
    try:
        ending.wait()
        world = swm.World("swm/TwoRoom-v1", num_envs=2, add_pixels=False, max_episode_steps=25)
        loaded.append(world)
    finally:
        ended.set()

ending, ended, loaded = threading.Event(), threading.Event(), []
threading.Thread(target=play, daemon=True).start()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, "thread ended\n", "")


def test_forked_program_ends_silently_while_threads_play():
    program = """
import os, sys, threading, time
import stable_worldmodel as swm

def play():
    world = swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(32, 32))
    world.set_policy(swm.policy.RandomPolicy())
    while True:
        world.collect(writer=swm.data.ReplayBuffer(1000), episodes=2, progress=False)

def start():
    for _ in range(3):
        threading.Thread(target=play, daemon=True).start()
    time.sleep(0.5)

start()
child = os.fork()
if child:
    assert os.waitpid(child, 0)[1] == 0
else:
    start()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
