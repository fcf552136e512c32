"""Tests of absurd counts, and of NaN and infinite values of environments."""

import os
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import NormalizeObservation, NormalizeReward

import stable_worldmodel as swm


class Faulty(gymnasium.Env):
    """Gives a NaN as its second reward."""

    action_space = spaces.Discrete(2)
    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.t += 1
        return np.float32([self.t]), np.nan if self.t == 2 else 0.0, False, False, {}


class Late(gymnasium.Env):
    """Has entries of `info` that the first reset and step lack."""

    action_space = spaces.Discrete(2)
    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(1, np.float32), {"lives": 3, "speed": None}

    def step(self, action):
        self.t += 1
        later = {"speed": 0.5, "success": True, "_own": 1, "name": "late"} if self.t > 1 else {}
        return np.float32([self.t]), 0.0, False, False, {"lives": 3, **later, f"bonus {self.t}": np.ones(2)}


class Given(gymnasium.Env):
    """Gives a reward and an entry `v` of `info` at its second step; the entry is a float32 before."""

    action_space = spaces.Discrete(2)
    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)

    def __init__(self, reward=0.0, v=0.0, render_mode=None):
        self.reward, self.v = reward, v

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self.np_random.normal(size=2), {"v": np.float32(0)}

    def step(self, action):
        self.t += 1
        reward, v = (self.reward, self.v) if self.t == 2 else (0.0, np.float32(0))
        return self.np_random.normal(size=2), reward, False, False, {"v": v}


if "Given-v0" not in gymnasium.registry:
    gymnasium.register("Given-v0", entry_point=Given, max_episode_steps=5)
if "Late-v0" not in gymnasium.registry:
    gymnasium.register("Late-v0", entry_point=Late, max_episode_steps=5)
if "Faulty-v0" not in gymnasium.registry:
    gymnasium.register("Faulty-v0", entry_point=Faulty, max_episode_steps=5)


@pytest.mark.parametrize(
    "absurd", [{"num_envs": 10**6}, {"threads": 10**5}, {"image_shape": (10**5, 10**5)}, {"max_episode_steps": 10**15}]
)
def test_absurd_counts_are_refused(absurd):
    with pytest.raises(ValueError, match="too large; choose at most"):
        swm.World("swm/TwoRoom-v1", **{"image_shape": (32, 32), **absurd})


@pytest.mark.parametrize(
    "wrong",
    [
        {"num_envs": 1.5},
        {"num_envs": 0},
        {"threads": -1},
        {"image_shape": (-1, 3)},
        {"max_episode_steps": -1},
        {"max_episode_steps": 2**70},
    ],
)
def test_numbers_that_are_no_counts_are_named(wrong):
    with pytest.raises(ValueError, match=f"{next(iter(wrong))}: .*expected a whole number of at least"):
        swm.World("swm/TwoRoom-v1", **{"image_shape": (32, 32), **wrong})


@pytest.mark.parametrize("wrong", [{"image_shape": "32"}, {"views": "pixels"}])
def test_text_in_place_of_a_list_is_refused(wrong):
    with pytest.raises(TypeError, match=f"{next(iter(wrong))}: "):
        swm.World("swm/TwoRoom-v1", **{"image_shape": (32, 32), **wrong})


def test_wrong_settings_of_a_collection_do_not_change_the_world(tmp_path):
    world = swm.World("swm/TwoRoom-v1", add_pixels=False, max_episode_steps=3)
    world.set_policy(swm.policy.RandomPolicy())
    settings = {"seed": 0, "progress": False}
    for wrong in ({"action_noise": np.nan}, {"episodes": 1.5}, {"episodes": 2**70}, {"policy": {"random": np.nan}}):
        name = "weight of 'random'" if "policy" in wrong else next(iter(wrong))
        with pytest.raises(ValueError, match=f"{name}: "):
            world.collect(tmp_path / "a.lance", **{"episodes": 1, **settings, **wrong})
    assert world.collect(tmp_path / "a.lance", episodes=1, **settings)["added"] == 1


def test_values_that_are_not_finite_are_counted_or_refused(tmp_path):
    world = swm.World("Faulty-v0", add_pixels=False)
    world.set_policy(swm.policy.RandomPolicy())
    path = tmp_path / "faulty.lance"
    with pytest.warns(UserWarning, match="2 in 'reward'"):
        assert world.collect(path, episodes=2, seed=0, progress=False)["added"] == 2
    with pytest.raises(ValueError, match="column 'reward' of episode 0 is not finite"):
        world.collect(tmp_path / "strict.lance", episodes=2, seed=0, progress=False, strict_finite=True)


def test_warnings_of_the_engine_are_warnings_of_python(capfd):
    # A command of the program prints its own.
    swm.cli.envs()

    def two_steps():
        world = swm.World("Faulty-v0", add_pixels=False)
        world.set_policy(swm.policy.RandomPolicy())
        world.reset(seed=0)
        world.step()
        world.step()

    with pytest.warns(UserWarning, match=r"^Faulty-v0: 'reward' has NaN or infinite values"):
        two_steps()
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*has NaN")
        with pytest.raises(UserWarning, match="'reward' has NaN"):
            two_steps()
    assert "NaN" not in capfd.readouterr().err


@pytest.mark.parametrize("reward", [1e39, -1e39, 10**400, np.float64(1e39)])
def test_rewards_beyond_single_precision_are_refused(reward, tmp_path):
    world = swm.World("Given-v0", add_pixels=False, reward=reward)
    with pytest.raises(ValueError, match=r"the reward of Given-v0 is .*stored in single precision.*scale it"):
        world.collect(tmp_path / "a.lance", episodes=1, policy=swm.policy.RandomPolicy(), progress=False)


@pytest.mark.parametrize("reward", [2**24 + 1, float(np.finfo(np.float32).max), -np.inf, np.float16(1), np.float16(np.inf)])
def test_rewards_are_rounded_to_single_precision(reward):
    world = swm.World("Given-v0", add_pixels=False, reward=reward)
    world.set_policy(swm.policy.RandomPolicy())
    world.reset(seed=0)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*infinite")
        world.step()
        world.step()
    assert world.rewards[0] == np.float32(reward)


@pytest.mark.parametrize("v", [1e39, 2**24 + 1, np.int64(-(2**24) - 1), 2**63 - 1, np.uint64(2**64 - 1)])
def test_values_that_a_column_of_floats_cannot_hold_are_refused(v, tmp_path):
    world = swm.World("Given-v0", add_pixels=False, v=v)
    with pytest.raises(ValueError, match=r"'info.v' has .*, which its column of float32 cannot hold"):
        world.collect(tmp_path / "a.lance", episodes=1, policy=swm.policy.RandomPolicy(), progress=False)


@pytest.mark.parametrize("v", [0.1, 123456789.123, 2**24, -(2**40), np.float64(np.inf), np.int64(-(2**63)), True])
def test_values_that_a_column_of_floats_holds_are_stored(v):
    world = swm.World("Given-v0", add_pixels=False, v=v)
    world.set_policy(swm.policy.RandomPolicy())
    world.reset(seed=0)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*infinite")
        world.step()
        world.step()
    assert world.infos["v"].dtype == np.float32 and world.infos["v"].item() == np.float32(v)


def frozen(env):
    wrapper = NormalizeObservation(env)
    wrapper.update_running_mean = False
    return wrapper


@pytest.mark.parametrize(
    ("wrappers", "named"),
    [
        ([NormalizeObservation], "NormalizeObservation"),
        ([NormalizeObservation, NormalizeReward, gymnasium.Wrapper], "NormalizeReward, NormalizeObservation"),
        ([frozen, gymnasium.Wrapper], None),
    ],
)
def test_wrappers_whose_statistics_carry_over_between_episodes_are_named_once(wrappers, named):
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        swm.World("Given-v0", num_envs=3, add_pixels=False, extra_wrappers=wrappers)
    expected = [] if named is None else [(f"Given-v0: statistics of {named} ", __file__)]
    texts = [(str(warning.message), warning.filename) for warning in found]
    assert [(text.partition("carry over")[0], file) for text, file in texts if "carry over" in text] == expected


def test_entries_of_info_that_appear_later_are_named_once(tmp_path):
    world = swm.World("Late-v0", num_envs=2, add_pixels=False)
    world.set_policy(swm.policy.RandomPolicy())
    with pytest.warns(UserWarning, match="in info: not in the info of the first reset and step") as found:
        world.collect(tmp_path / "late.lance", episodes=4, seed=0, progress=False)
    texts = [str(warning.message).partition(" in info:")[0] for warning in found if "in info:" in str(warning.message)]
    assert texts == ["Late-v0: 'speed', 'bonus 2'"]
    dataset = swm.data.load_dataset(tmp_path / "late.lance")
    assert {"lives", "bonus_1"} <= set(dataset.column_names) and not {"speed", "bonus_2"} & set(dataset.column_names)


def test_entries_of_info_that_appear_later_in_workers_are_named_once(monkeypatch):
    folders = [os.path.dirname(__file__), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(folders))
    monkeypatch.setenv("SWM_PYTHON", sys.executable)
    with swm.World(f"{__name__}:Late-v0", num_envs=2, add_pixels=False, workers=True) as world:
        world.set_policy(swm.policy.RandomPolicy())
        world.reset(seed=0)
        with pytest.warns(UserWarning, match="Late-v0: 'speed', 'bonus 2' in info") as found:
            for _ in range(4):
                world.step()
    assert len([warning for warning in found if "in info" in str(warning.message)]) == 1
