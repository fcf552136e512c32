"""Tests of actions without bounds."""

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

import stable_worldmodel as swm

BOUNDS = {"Both": (-np.inf, np.inf), "Above": (5.0, np.inf), "Below": (-np.inf, -5.0)}


class Unbounded(gymnasium.Env):
    """Observes its last action, and ends with an error at one that is not in its space."""

    metadata = {"render_modes": ["rgb_array"]}
    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)

    def __init__(self, bounds, render_mode=None):
        self.action_space = spaces.Box(*BOUNDS[bounds], (1,), np.float32)
        self.render_mode = render_mode

    def render(self):
        return np.zeros((16, 16, 3), np.uint8)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        return action, 0.0, False, False, {}


for name in BOUNDS:
    if f"{name}-v0" not in gymnasium.registry:
        gymnasium.register(f"{name}-v0", entry_point=Unbounded, kwargs={"bounds": name}, max_episode_steps=50)


class Constant(swm.policy.BasePolicy):
    """A policy that returns one value."""

    def __init__(self, value):
        super().__init__()
        self.value = value

    def get_action(self, infos, **kwargs):
        return np.full(self.env.action_space.shape, self.value, np.float32)


def collected(path, name, policy, **options):
    world = swm.World(f"{name}-v0", num_envs=2, image_shape=(16, 16))
    world.set_policy(policy)
    world.collect(path, episodes=4, seed=3, progress=False, **options)
    actions = np.asarray(swm.data.load_dataset(path).get_col_data("action"))
    return world, actions[np.isfinite(actions)]


@pytest.mark.parametrize("name", BOUNDS)
def test_random_actions_are_drawn_where_the_space_has_them(name, tmp_path):
    world, actions = collected(tmp_path / "random.lance", name, swm.policy.RandomPolicy(seed=0))
    low, high = BOUNDS[name]
    space = world.single_action_space
    assert (space.low == np.float32(low)).all() and (space.high == np.float32(high)).all()
    assert ((actions >= low) & (actions <= high)).all()
    assert actions.std() > 0.5 and np.abs(actions - np.median(actions)).max() > 2, "beyond a range of one"


def test_noise_keeps_actions_beyond_one(tmp_path):
    _, actions = collected(tmp_path / "noise.lance", "Both", Constant(7.5), action_noise=0.01)
    assert np.abs(actions - 7.5).max() < 0.1 and actions.std() > 0


def test_noise_is_clipped_at_the_bound_that_there_is(tmp_path):
    _, actions = collected(tmp_path / "clipped.lance", "Above", Constant(5.0), action_noise=0.5)
    assert actions.min() == 5.0 and actions.max() > 5.5


class Half(Unbounded):
    """An environment whose actions are in half precision."""

    def __init__(self, render_mode=None):
        self.action_space = spaces.Box(-np.inf, np.inf, (1,), np.float16)
        self.render_mode = render_mode

    def step(self, action):
        assert action.dtype == np.float16
        return action.astype(np.float32), 0.0, False, False, {}


if "Half-v0" not in gymnasium.registry:
    gymnasium.register("Half-v0", entry_point=Half, max_episode_steps=50)


def test_actions_that_half_precision_does_not_hold_are_refused():
    world = swm.World("Half-v0", num_envs=2, image_shape=(16, 16))
    world.reset(seed=0)
    world.envs.step(np.full((2, 1), 6e4))
    with pytest.raises(ValueError, match=r"the action \[100000.\] is outside the numbers of float16"):
        world.envs.step(np.array([[1.0], [1e5]]))
