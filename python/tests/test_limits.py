"""Tests of absurd counts, and of NaN and infinite values of environments."""

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


def test_values_that_are_not_finite_are_counted_or_refused(tmp_path):
    world = swm.World("Faulty-v0", add_pixels=False)
    world.set_policy(swm.policy.RandomPolicy())
    path = tmp_path / "faulty.lance"
    with pytest.warns(UserWarning, match="2 in 'reward'"):
        assert world.collect(path, episodes=2, seed=0, progress=False)["added"] == 2
    with pytest.raises(ValueError, match="column 'reward' of episode 0 is not finite"):
        world.collect(tmp_path / "strict.lance", episodes=2, seed=0, progress=False, strict_finite=True)
