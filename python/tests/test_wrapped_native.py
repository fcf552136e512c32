"""Native environments in a Gymnasium wrapper of the user, which changes nothing."""

import gymnasium
import numpy as np
import pytest

import stable_worldmodel as swm


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


def test_time_limit_is_that_of_the_environment(world):
    with swm.World(world.env_name, num_envs=1, image_shape=(32, 32)) as plain:
        assert world.max_episode_steps == plain.max_episode_steps


def test_camera_views_are_refused():
    with pytest.raises(ValueError, match=r"views: \['depth'\].*leave out the wrappers"):
        swm.World("swm/TwoRoom-v1", num_envs=1, image_shape=(32, 32), extra_wrappers=[Same], views=["depth"])


def test_the_simulator_refuses_environments_in_wrappers(world):
    solver = swm.solver.CEMSolver("simulator", num_samples=4, n_steps=1, topk=2)
    world.set_policy(swm.policy.WorldModelPolicy(solver, swm.PlanConfig(horizon=2, receding_horizon=1)))
    world.reset(seed=0)
    with pytest.raises(ValueError, match="without wrappers written in Python"):
        world.step()
