"""Tests of the success that Gymnasium environments state in their infos."""

import gymnasium
import numpy as np
import pytest

import stable_worldmodel as swm


class Stating(gymnasium.Env):
    """States its success in the steps of `stated` only, and terminates after four."""

    observation_space = gymnasium.spaces.Box(-9, 9, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, stated=(), render_mode=None):
        self.stated = dict(stated)

    def info(self):
        return {"success": self.stated[self.t]} if self.t in self.stated else {}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(1, np.float32), self.info()

    def step(self, action):
        self.t += 1
        return np.float32([self.t]), 0.0, self.t == 4, False, self.info()


@pytest.mark.parametrize(
    ("stated", "rate"),
    [
        ({}, 100.0),
        ({4: False}, 0.0),
        ({0: False, 1: False, 2: False, 3: False}, 0.0),
        ({0: False, 3: True}, 100.0),
        ({4: True}, 100.0),
    ],
)
def test_a_missing_success_is_none_after_false(stated, rate):
    gymnasium.register("Stating-v0", entry_point=lambda **given: Stating(stated, **given), max_episode_steps=9)
    try:
        with swm.World("Stating-v0", num_envs=1, add_pixels=False) as world:
            found = world.evaluate(policy=swm.policy.RandomPolicy(), episodes=3, seed=0, progress=False, floor=False)
    finally:
        gymnasium.registry.pop("Stating-v0")
    assert found["success_rate"] == rate
