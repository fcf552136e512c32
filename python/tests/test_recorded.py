"""Tests of evaluations of Gymnasium environments from recorded states, in this interpreter and in worker processes."""

import os
import signal
import sys
import warnings
from functools import partial

import gymnasium
import numpy as np
import pytest
from test_interrupts import children

import stable_worldmodel as swm

#: The source of a module that the tests and the worker processes import.
MODULE = '''
import os
import signal

import gymnasium
import numpy as np
from gymnasium import spaces


class Field(gymnasium.Env):
    """A point with a goal position, in a wind that the seed determines."""

    metadata = {"render_modes": ["rgb_array"]}

    def __init__(self, render_mode=None, marker=None):
        self.render_mode, self.marker = render_mode, marker
        self.action_space = spaces.Box(-0.3, 0.3, (2,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.wind = self.np_random.uniform(-0.02, 0.02, 2)
        self.position, self.goal = self.np_random.uniform(-1, 1, (2, 2))
        self.is_set = False
        return self.position, self.info()

    def info(self):
        return {"state": self.position, "goal_state": self.goal, "wind": self.wind, "is_set": self.is_set}

    def _set_state(self, state):
        self.position, self.is_set = np.array(state), True

    def _set_goal_state(self, goal_state):
        self.goal = np.array(goal_state)

    def step(self, action):
        if self.marker and self.is_set and not os.path.exists(self.marker):
            open(self.marker, "w").close()
            os.kill(os.getpid(), signal.SIGKILL)
        self.position = self.position + action + self.wind
        return self.position, 0.0, bool(np.abs(self.position - self.goal).max() < 0.03), False, self.info()

    def render(self):
        image = np.zeros((32, 32, 3), np.uint8)
        for point, channel in ((self.position, 0), (self.goal, 1)):
            x, y = np.clip((point + 2) * 8, 0, 29).astype(int)
            image[y : y + 3, x : x + 3, channel] = 255
        return image


class Quiet(Field):
    """A `Field` whose setters do not have the default names."""

    _set_state = _set_goal_state = None

    def teleport(self, where, scale):
        Field._set_state(self, where * scale)

    def aim(self, at):
        Field._set_goal_state(self, at)


gymnasium.register("Field-v0", Field, max_episode_steps=40)
gymnasium.register("Quiet-v0", Quiet, max_episode_steps=40)
'''

CALLABLES = [
    {"method": "_set_state", "args": {"state": {"value": "state", "in_dataset": True}}},
    {"method": "_set_goal_state", "args": {"goal_state": {"value": "goal_state"}}},
]
OWN = [
    {"method": "teleport", "args": {"where": {"value": "state"}, "scale": {"value": np.float64(1), "in_dataset": False}}},
    {"method": "aim", "args": {"at": {"value": "goal_state"}}},
]


class Seeking(swm.policy.BasePolicy):
    """Moves to the goal state of the infos; records the infos of the first step of every episode."""

    def __init__(self):
        super().__init__()
        self.first, self.goals = [], []

    def get_action(self, infos, **kwargs):
        for slot in np.flatnonzero(infos["_needs_flush"]):
            self.first.append((infos["state"][slot, 0].copy(), infos["wind"][slot, 0].copy()))
            self.goals.append(infos["goal"][slot, 0].copy())
        offset = infos["goal_state"][:, 0] - infos["state"][:, 0]
        return np.clip(offset, -0.3, 0.3).astype(np.float32)


@pytest.fixture
def fields(tmp_path, monkeypatch):
    """Makes the module importable here and in workers; yields a function from a class name to an environment id."""
    (tmp_path / "fields_of_mine.py").write_text(MODULE)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("SWM_PYTHON", sys.executable)
    yield "fields_of_mine:{}-v0".format
    sys.modules.pop("fields_of_mine", None)
    for name in ("Field-v0", "Quiet-v0"):
        gymnasium.registry.pop(name, None)


@pytest.fixture
def recorded(fields, tmp_path):
    world = swm.World(fields("Field"), num_envs=2, image_shape=(32, 32))
    world.set_policy(swm.policy.RandomPolicy(seed=2))
    world.collect(tmp_path / "fields.lance", episodes=4, seed=7, progress=False)
    return swm.data.load_dataset(str(tmp_path / "fields.lance"), backend="numpy")


PICKS = {"episodes_idx": [0, 1, 2, 3, 0], "start_steps": [0, 3, 1, 8, 5], "goal_offset": 6, "eval_budget": 30}


def evaluate(world, dataset, policy=None, **more):
    return world.evaluate(dataset=dataset, **{**PICKS, "progress": False, "seed": 0, **more}, policy=policy or Seeking())


@pytest.mark.parametrize(("name", "callables"), [("Field", CALLABLES), ("Field", None), ("Quiet", OWN)])
def test_episodes_start_at_recorded_states(fields, recorded, name, callables):
    found = []
    for envs, workers in ((2, False), (3, True), (5, False)):
        world, policy = swm.World(fields(name), num_envs=envs, image_shape=(32, 32), workers=workers), Seeking()
        metrics = evaluate(world, recorded, policy, callables=callables)
        assert metrics["success_rate"] == 100 and metrics["random_success_rate"] < 100
        found.append((metrics["steps"].tolist(), metrics["episode_successes"].tolist()))
        starts = {tuple(state) for state, _ in policy.first}
        for episode, start in zip(PICKS["episodes_idx"], PICKS["start_steps"], strict=True):
            rows = recorded.load_episode(episode)
            assert tuple(rows["state"][start]) in starts
            wind = next(wind for state, wind in policy.first if np.array_equal(state, rows["state"][start]))
            assert np.array_equal(wind, rows["wind"][0]), "the seed is the recorded one"
            goal = rows["pixels"][start + 6].transpose(1, 2, 0)
            assert any(np.array_equal(goal, shown) for shown in policy.goals), "the goal's frame is the recorded one"
        stored = metrics.results["manifest"]["config"]["callables"]
        assert [call["method"] for call in stored] == [call["method"] for call in callables or []]
        world.close()
    assert found[0] == found[1] == found[2]


def test_restarted_worker_starts_at_the_recorded_state(fields, recorded, tmp_path):
    expected = evaluate(
        swm.World(fields("Field"), num_envs=2, image_shape=None, add_pixels=False), recorded, floor=False, policy=Blind()
    )
    marker = tmp_path / "died"
    world = swm.World(fields("Field"), num_envs=2, image_shape=None, add_pixels=False, workers=True, marker=str(marker))
    metrics = evaluate(world, recorded, floor=False, policy=Blind())
    assert marker.exists() and metrics["success_rate"] == 100
    assert np.array_equal(metrics["steps"], expected["steps"])


class Blind(Seeking):
    """A policy for an environment without frames."""

    def get_action(self, infos, **kwargs):
        return super().get_action({**infos, "goal": infos["state"]})


def test_worker_killed_between_steps_is_replaced(fields, recorded):
    class Killing(Seeking):
        killed = False

        def get_action(self, infos, **kwargs):
            if not Killing.killed and infos["step_idx"].max() == 2:
                Killing.killed = True
                os.kill(min(workers), signal.SIGKILL)
            return super().get_action(infos)

    expected = evaluate(swm.World(fields("Field"), num_envs=2, image_shape=(32, 32)), recorded, floor=False)
    before = set(children(os.getpid()))
    world = swm.World(fields("Field"), num_envs=2, image_shape=(32, 32), workers=True)
    workers = set(children(os.getpid())) - before
    metrics = evaluate(world, recorded, Killing(), floor=False)
    assert Killing.killed and np.array_equal(metrics["steps"], expected["steps"])


@pytest.mark.parametrize("workers", [False, True])
def test_wrong_callables_raise_errors_with_the_reason(fields, recorded, workers):
    def error(callables, name="Quiet", kind=ValueError):
        world = swm.World(fields(name), num_envs=2, image_shape=(32, 32), workers=workers)
        with pytest.raises(kind) as caught:
            evaluate(world, recorded, callables=callables)
        return str(caught.value)

    def call(method, **args):
        return [{"method": method, "args": args}]

    unknown = error(call("teleprot"))
    assert all(words in unknown for words in ("no method 'teleprot'", "did you mean teleport", "aim")), unknown
    missing = error(call("teleport", where={"value": "place"}, scale={"value": 1, "in_dataset": False}))
    assert "'place'" in missing and "state" in missing and "goal_" in missing
    assert "set_state" in error(None) and "callables" in error(None)
    assert "COLUMN" in error(call("teleport", where="state"))
    assert "column" in error(call("teleport", where={"value": 3}))
    assert "numeric array" in error(call("aim", at={"value": object(), "in_dataset": False}), kind=TypeError)
    raised = RuntimeError if workers else TypeError
    assert "where" in error(call("teleport", scale={"value": 1, "in_dataset": False}), kind=raised)


def test_native_environments_restore_recorded_states_without_callables(tmp_path):
    world = swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(32, 32))
    world.set_policy(swm.policy.ExpertPolicy())
    world.collect(tmp_path / "rooms.lance", episodes=3, seed=1, progress=False)
    picks = {"dataset": str(tmp_path / "rooms.lance"), "episodes_idx": [0, 1, 2], "start_steps": [0, 1, 2], "goal_offset": 4}
    picks |= {"eval_budget": 20, "progress": False, "floor": False, "seed": 0}
    plain = world.evaluate(**picks)
    assert np.array_equal(world.evaluate(**picks, callables=CALLABLES)["steps"], plain["steps"])
    with pytest.warns(UserWarning, match="set_colour.*not called"):
        world.evaluate(**picks, callables=[{"method": "set_colour"}])
    with pytest.warns(UserWarning, match="callables: without a dataset"):
        world.evaluate(episodes=1, eval_budget=1, floor=False, progress=False, callables=CALLABLES)

    class Same(gymnasium.Wrapper):
        """A wrapper without effect, which makes a native environment run in this interpreter."""

    wrapped = swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(32, 32), extra_wrappers=[partial(Same)])
    for one in (world, wrapped):
        one.set_policy(Still())
    plain, wrapped = (one.evaluate(**picks) for one in (world, wrapped))
    assert np.array_equal(plain["steps"], wrapped["steps"])


class Timed(gymnasium.Env):
    """A point whose state has the time as well, which its goal does not."""

    observation_space = gymnasium.spaces.Box(-9, 9, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, render_mode=None):
        self.time = 0.0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        (self.at, self.goal), self.time = self.np_random.uniform(-3, 3, (2, 2)), 0.0
        return self.at, self.info()

    def info(self):
        goals = {"goal": self.goal, "goal_state": self.goal, "goal_radius": 0.5, "goal_at": self.goal}
        return {"state": np.append(self.at, self.time), **goals}

    def step(self, action):
        self.at, self.time = self.at + action, self.time + 1
        return self.at, 0.0, False, False, self.info()

    def set_state(self, state):
        self.at, self.time = np.array(state[:2]), state[2]

    def set_goal_state(self, goal_state):
        self.goal = np.array(goal_state[:2])


class Telling(Timed):
    def _get_info(self):
        return self.info()


@pytest.mark.parametrize("kind", [Timed, Telling])
def test_goals_that_the_goal_row_does_not_tell_are_asked_for_or_nan(tmp_path, kind):
    gymnasium.register("Timed-v0", entry_point=kind, max_episode_steps=9)
    seen = []

    class Seeing(swm.policy.BasePolicy):
        def get_action(self, infos, **named):
            seen.append((infos["goal_state"][0, 0].copy(), infos["goal_radius"][0, 0], infos["info_goal"][0, 0].copy()))
            return np.zeros((1, 2), np.float32)

    try:
        with swm.World("Timed-v0", num_envs=1, add_pixels=False) as world:
            world.collect(tmp_path / "t.h5", policy=swm.policy.RandomPolicy(), episodes=1, seed=3, progress=False)
            goal = swm.data.load_dataset(tmp_path / "t.h5", backend="numpy").load_episode(0)["state"][4, :2]
            picks = {"episodes_idx": [0], "start_steps": [1], "goal_offset": 3, "eval_budget": 2}
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                world.evaluate(policy=Seeing(), dataset=tmp_path / "t.h5", **picks, seed=2, progress=False, floor=False)
    finally:
        gymnasium.registry.pop("Timed-v0")
    warned = [str(warning.message) for warning in caught if "until the first step" in str(warning.message)]
    assert not any(str(warning.message).startswith("Timed-v0: ") for warning in caught)
    assert seen[0][1] == 0.5 and np.array_equal(seen[1][0], goal)
    if kind is Telling:
        assert not warned and np.array_equal(seen[0][0], goal) and np.array_equal(seen[0][2], goal)
    else:
        assert sorted(text.split()[0] for text in warned) == ["'goal_state'", "'info_goal'"]
        assert np.isnan(seen[0][0]).all() and np.isnan(seen[0][2]).all()


class Reaching(gymnasium.Env):
    """A goal environment as those of Gymnasium-Robotics."""

    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    observation_space = gymnasium.spaces.Dict(
        {key: gymnasium.spaces.Box(-99, 99, (2,), np.float64) for key in ("observation", "achieved_goal", "desired_goal")}
    )

    def __init__(self, render_mode=None):
        pass

    def observed(self):
        return {"observation": self.at, "achieved_goal": self.at, "desired_goal": self.goal}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        (self.at, self.goal), self.steps = self.np_random.uniform(-3, 3, (2, 2)), -9
        # Of the state that the reset draws, not of a recorded one.
        return self.observed(), {"success": False}

    def step(self, action):
        self.at, self.steps = self.at + action, self.steps + 1
        return self.observed(), 0.0, self.steps == 3, False, {}

    def set_state(self, observation):
        self.at, self.steps = np.array(observation), 0

    def set_goal(self, goal):
        self.goal = np.array(goal)


def test_desired_goal_is_what_the_goal_row_achieved_from_the_first_step_on(tmp_path):
    gymnasium.register("Reaching-v0", entry_point=Reaching, max_episode_steps=9)
    seen = []

    class Seeing(swm.policy.BasePolicy):
        def get_action(self, infos, **named):
            seen.append(infos["desired_goal"][0, 0].copy())
            return np.zeros((1, 2), np.float32)

    calls = [
        {"method": "set_state", "args": {"observation": {"value": "observation"}}},
        {"method": "set_goal", "args": {"goal": {"value": "goal_achieved_goal"}}},
    ]
    try:
        with swm.World("Reaching-v0", num_envs=1, add_pixels=False) as world:
            world.collect(tmp_path / "t.h5", policy=swm.policy.RandomPolicy(), episodes=1, seed=3, progress=False)
            goal = swm.data.load_dataset(tmp_path / "t.h5", backend="numpy").load_episode(0)["achieved_goal"][4]
            picks = {"episodes_idx": [0], "start_steps": [1], "goal_offset": 3, "eval_budget": 3, "callables": calls}
            found = world.evaluate(policy=Seeing(), dataset=tmp_path / "t.h5", **picks, seed=2, progress=False, floor=False)
    finally:
        gymnasium.registry.pop("Reaching-v0")
    assert len(seen) == 3 and all(np.array_equal(one, goal) for one in seen)
    assert found["success_rate"] == 100.0


class Still(swm.policy.BasePolicy):
    def get_action(self, infos, **kwargs):
        return np.zeros(self.env.action_space.shape, np.float32)
