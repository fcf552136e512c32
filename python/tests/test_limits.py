"""Tests of absurd counts, and of NaN and infinite values of environments."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

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
