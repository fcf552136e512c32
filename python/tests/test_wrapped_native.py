"""Native environments in Gymnasium wrappers of the user."""

import pickle
from functools import partial

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RescaleAction, TimeAwareObservation, TimeLimit, TransformObservation

import stable_worldmodel as swm
from stable_worldmodel.wrapper.visual import GrayscaleWrapper, NoiseWrapper


class Same(gymnasium.Wrapper):
    """Changes nothing."""


@pytest.fixture(params=["swm/TwoRoom-v1", "swm/PushT-v1"])
def world(request):
    with swm.World(request.param, num_envs=2, image_shape=(32, 32), extra_wrappers=[Same]) as world:
        yield world


def truths(world):
    """The factors of every environment by name."""
    return [env.unwrapped._env.factors() for env in world.gym_envs[-world.num_envs :]]


def test_infos_have_the_factors_and_the_goal_of_the_episode(world):
    seen = []
    for seed in (3, 4):
        world.reset(seed=seed, options={"variation": ["all"]})
        for index, factors in enumerate(truths(world)):
            given = world.factors(index)
            for name, value in factors.items():
                assert np.allclose(given[name], value), name
                assert np.allclose(world.infos[f"variation.{name}"][index, 0], value), name
            goal = world.gym_envs[-world.num_envs :][index].unwrapped.render_goal()
            assert (world.infos["goal"][index, 0] == goal).all() and goal.max() > 0
            seen.append(np.concatenate([np.ravel(value) for value in factors.values()]))
    assert len(np.unique(seen, axis=0)) == 4


def test_datasets_have_the_factors_of_their_episodes(world, tmp_path):
    expected = []

    class Seeing(swm.policy.BasePolicy):
        def get_action(self, infos, **named):
            expected.extend(np.ravel(factors["background.color"]) for factors in truths(world))
            return np.zeros((2, 2), np.float32)

    options = {"variation": ["background.color"]}
    path = tmp_path / "varied.h5"
    world.collect(path, policy=Seeing(), episodes=4, seed=5, options=options, goal=True, progress=False)
    dataset = swm.data.load_dataset(path, backend="numpy")
    recorded = [dataset.load_episode(episode)["variation.background.color"][0] for episode in range(4)]
    assert len(np.unique(recorded, axis=0)) == 4
    assert all(any(np.allclose(one, other) for other in expected) for one in recorded)
    assert all(dataset.load_episode(episode)["goal"].max() > 0 for episode in range(4))


def test_seeds_mean_the_same_episodes_as_without_the_wrapper(world, tmp_path):
    def rows(one, name):
        one.collect(tmp_path / name, policy=swm.policy.RandomPolicy(seed=1), episodes=2, seed=3, progress=False)
        dataset = swm.data.load_dataset(tmp_path / name, backend="numpy")
        return [dataset.load_episode(episode) for episode in range(2)]

    with swm.World(world.env_name, num_envs=2, image_shape=(32, 32)) as plain:
        for seed in (3, [2**40 + 5, 2**62 - 1]):
            for one in (world, plain):
                one.reset(seed=seed)
            for column in ("state", "goal_state"):
                assert np.array_equal(world.infos[column], plain.infos[column]), column
        wrapped, expected = rows(world, "wrapped.h5"), rows(plain, "plain.h5")
        for one, other in zip(wrapped, expected, strict=True):
            assert np.array_equal(one["episode_seed"], other["episode_seed"]) and np.array_equal(one["state"], other["state"])


class OldGenerator(gymnasium.Wrapper):
    """Seeds numpy's generator of before 2019, which takes 32 bits."""

    def reset(self, *, seed=None, options=None):
        self.noise = np.random.RandomState(seed).normal()
        return self.env.reset(seed=seed, options=options)


def test_wrappers_get_seeds_of_32_bits(tmp_path):
    with swm.World("swm/TwoRoom-v1", num_envs=1, image_shape=(32, 32), extra_wrappers=[OldGenerator]) as world:
        world.collect(tmp_path / "r.h5", policy=swm.policy.RandomPolicy(), episodes=2, seed=3, progress=False)
    with swm.World("swm/TwoRoom-v1", num_envs=1, image_shape=(32, 32)) as world:
        world.collect(tmp_path / "plain.h5", policy=swm.policy.RandomPolicy(), episodes=2, seed=3, progress=False)
    wrapped, plain = (swm.data.load_dataset(tmp_path / name, backend="numpy").load_episode(1) for name in ("r.h5", "plain.h5"))
    assert np.array_equal(wrapped["state"], plain["state"])


def test_first_infos_of_a_recorded_start_have_the_goal(tmp_path):
    """Reacher's `goal_state` has another length than its `state`."""
    firsts = []

    class Seeing(swm.policy.BasePolicy):
        def get_action(self, infos, **named):
            firsts[-1].extend(infos["goal_state"][infos["_needs_flush"], 0].tolist())
            return np.zeros((2, 2), np.float32)

    name, picks = "swm/ReacherDMControl-v0", {"episodes_idx": [0, 1], "start_steps": [2, 5], "goal_offset": 4}
    with swm.World(name, num_envs=2, image_shape=(32, 32), max_episode_steps=20) as plain:
        plain.collect(tmp_path / "r.h5", policy=swm.policy.RandomPolicy(), episodes=2, seed=3, progress=False)
        for extra in ([], [Same]):
            firsts.append([])
            with swm.World(name, num_envs=2, image_shape=(32, 32), max_episode_steps=20, extra_wrappers=extra) as world:
                world.evaluate(
                    policy=Seeing(), dataset=tmp_path / "r.h5", **picks, eval_budget=3, seed=2, progress=False, floor=False
                )
    assert len(firsts[0]) == 2 and np.allclose(firsts[0], firsts[1])


def test_time_limit_is_that_of_the_environment(world):
    with swm.World(world.env_name, num_envs=1, image_shape=(32, 32)) as plain:
        assert world.max_episode_steps == plain.max_episode_steps


def test_wrappers_that_need_a_time_limit_are_told_where_it_is():
    given = {"image_shape": (16, 16), "max_episode_steps": 4}
    with pytest.raises(
        ValueError, match="The engine enforces the time limit, .* TimeAwareObservation\\(TimeLimit\\(env, 100\\)\\)"
    ):
        swm.World("CartPole-v1", extra_wrappers=[TimeAwareObservation], **given)
    with swm.World("CartPole-v1", extra_wrappers=[lambda env: TimeAwareObservation(TimeLimit(env, 4))], **given) as world:
        world.set_policy(swm.policy.RandomPolicy())
        world.reset(seed=0)
        world.step(2)
        assert world.infos["observation"].shape == (1, 1, 5) and world.infos["observation"][0, 0, 4] == 2


def test_camera_views_are_refused():
    with pytest.raises(ValueError, match=r"views: \['depth'\].*leave out the wrappers"):
        swm.World("swm/TwoRoom-v1", num_envs=1, image_shape=(32, 32), extra_wrappers=[Same], views=["depth"])


def test_the_simulator_refuses_environments_in_wrappers(world):
    solver = swm.solver.CEMSolver("simulator", num_samples=4, n_steps=1, topk=2)
    world.set_policy(swm.policy.WorldModelPolicy(solver, swm.PlanConfig(horizon=2, receding_horizon=1)))
    world.reset(seed=0)
    with pytest.raises(ValueError, match="without wrappers written in Python"):
        world.step()


class Discretized(gymnasium.ActionWrapper):
    """Has discrete actions."""

    def __init__(self, env):
        super().__init__(env)
        self.action_space = gymnasium.spaces.Discrete(3)

    def action(self, action):
        return np.array([action - 1, 0], np.float32)


class Halves(gymnasium.ActionWrapper):
    """Rounds actions of a `MultiDiscrete` space with as many values."""

    def __init__(self, env):
        super().__init__(env)
        self.action_space = gymnasium.spaces.MultiDiscrete([3, 3])

    def action(self, action):
        return np.asarray(action, np.float32) - 1


@pytest.mark.parametrize("wrap", [Discretized, Halves, lambda env: RescaleAction(env, -4.0, 4.0)])
@pytest.mark.parametrize("policy", [swm.policy.ExpertPolicy(), swm.policy.MixturePolicy({"random": 1, "expert": 1})])
def test_experts_refuse_other_actions(wrap, policy):
    with swm.World("swm/TwoRoom-v1", num_envs=2, add_pixels=False, max_episode_steps=4, extra_wrappers=[wrap]) as world:
        words = "change the action space from Box.*write a policy that converts"
        with pytest.raises(ValueError, match=words):
            world.evaluate(policy=policy, episodes=2, seed=0, progress=False)
        with pytest.raises(ValueError, match=words):
            world.collect(writer=swm.data.ReplayBuffer(100), episodes=2, seed=0, progress=False)
        world.reset(seed=0)
        with pytest.raises(ValueError, match=words):
            world.step()
        for other in (swm.policy.RandomPolicy(), swm.policy.MixturePolicy({"random": 1})):
            world.collect(writer=swm.data.ReplayBuffer(100), policy=other, episodes=2, seed=0, progress=False)


def smaller(env):
    """Divides the observation by 100."""
    nested = isinstance(env.observation_space, gymnasium.spaces.Dict)
    change = (lambda seen: {key: value / 100 for key, value in seen.items()}) if nested else lambda seen: seen / 100
    return TransformObservation(env, change, env.observation_space)


def renamed(env):
    """Renames the state."""
    return swm.wrapper.MapKeysWrapper(env, {"goal_state": "target"})


@pytest.mark.parametrize(
    ("name", "wrap", "columns"),
    [
        ("swm/PushT-v1", smaller, "'state', 'proprio'"),
        ("swm/FetchReachDict-v3", smaller, "'achieved_goal', 'desired_goal', 'observation'"),
        ("swm/TwoRoom-v1", renamed, "'goal_state'"),
    ],
)
def test_experts_refuse_other_columns(name, wrap, columns):
    with swm.World(name, num_envs=2, add_pixels=False, max_episode_steps=4, extra_wrappers=[wrap]) as world:
        with pytest.raises(ValueError, match=rf"change or remove the columns \[{columns}\]"):
            world.evaluate(policy=swm.policy.ExpertPolicy(), episodes=2, seed=0, progress=False)


class Rounded(gymnasium.ActionWrapper):
    """Has the same action space, of 64-bit values."""

    def __init__(self, env):
        super().__init__(env)
        low, high = env.action_space.low, env.action_space.high
        self.action_space = gymnasium.spaces.Box(low.astype(np.float64), high.astype(np.float64), dtype=np.float64)

    def action(self, action):
        return action.astype(np.float32)


@pytest.mark.parametrize(
    "name", ["swm/PushT-v1", "swm/TwoRoom-v1", "swm/FetchReach-v3", "swm/ReacherDMControl-v0", "swm/CartPoleControl-v1"]
)
@pytest.mark.parametrize("steps", [0, 3])
def test_experts_play_in_wrappers_that_change_neither(name, steps):
    wrappers = [Same] if "CartPole" in name else [Same, Rounded]
    played = []
    for wrapped in ([], wrappers):
        with swm.World(name, num_envs=2, add_pixels=False, max_episode_steps=9, extra_wrappers=wrapped) as world:
            world.set_policy(swm.policy.RandomPolicy())
            world.reset(seed=[3, 4])
            world.step(steps)
            world.set_policy(swm.policy.ExpertPolicy())
            world.step(2)
            played.append(world.infos["action"].copy())
            world.evaluate(episodes=2, seed=1, progress=False, floor=False)
    assert np.array_equal(*played)


def test_experts_of_ogbench_play_in_wrappers():
    written = []
    for wrapped in ([], [Same]):
        with swm.World("swm/OGBMaze-v0", add_pixels=False, extra_wrappers=wrapped) as world:
            world.set_policy(swm.policy.ExpertPolicy())
            world.reset(seed=[7])
            world.step(5)
            written.append([world.infos[key].copy() for key in ("action", "goal/next_xy")])
            world.evaluate(episodes=1, seed=0, progress=False, floor=False)
    for one, other in zip(*written, strict=True):
        assert np.array_equal(one, other)


def test_the_frame_of_the_goal_is_changed_or_the_reason_given():
    with swm.World("swm/TwoRoom-v1", image_shape=(32, 32), extra_wrappers=[GrayscaleWrapper], wrap_goal=True) as world:
        world.reset(seed=0)
        assert np.ptp(world.infos["goal"], axis=-1).max() == 0
    with pytest.raises(ValueError, match="wrap_goal: visual wrappers.*leave those out"):
        swm.World("swm/TwoRoom-v1", image_shape=(32, 32), extra_wrappers=[Same, GrayscaleWrapper], wrap_goal=True)
    swm.World("swm/TwoRoom-v1", image_shape=(32, 32), extra_wrappers=[Same], wrap_goal=True).close()


def test_stacked_wrappers_draw_as_in_the_engine():
    noise = partial(NoiseWrapper, std=10.0)
    frames = []
    for wrappers in ([noise, noise], [Same, noise, Same, noise], [noise], []):
        with swm.World("swm/TwoRoom-v1", image_shape=(32, 32), extra_wrappers=wrappers) as world:
            world.reset(seed=[7], options={"variation_values": {"background.color": [128, 128, 128]}})
            frames.append(world.infos["pixels"][0, 0].astype(float))
    assert np.array_equal(frames[0], frames[1])
    plain = frames.pop()
    two, one = ((frame - plain)[plain == 128].std() for frame in frames[1:])
    assert 1.3 < two / one < 1.5
    env = NoiseWrapper(NoiseWrapper(gymnasium.make("swm/TwoRoom-v1", image_shape=(32, 32)), std=10.0), std=10.0)
    env.reset(seed=7)
    assert np.array_equal(pickle.loads(pickle.dumps(env)).render(), env.render())


def test_a_policy_of_the_user_may_convert_the_actions_of_an_expert():
    class Doubled(swm.policy.ExpertPolicy):
        def get_action(self, obs, **named):
            return 2 * super().get_action(obs)

    class Rescaled(gymnasium.wrappers.RescaleAction):
        def __init__(self, env):
            super().__init__(env, -2.0, 2.0)

    with swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(32, 32), extra_wrappers=[Rescaled]) as world:
        world.set_policy(Doubled())
        world.reset(seed=1)
        largest = 0.0
        for _ in range(100):
            world.step()
            largest = max(largest, float(np.nanmax(np.abs(world.infos["action"]))))
            if world.terminateds.any():
                break
        assert world.terminateds.any() and 1 < largest <= 2
