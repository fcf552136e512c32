"""Tests of the classes of MuJoCo environments: DeepMind Control, OGBench, Fetch. They need `swm assets install`."""

import importlib
import inspect
import pickle

import gymnasium
import numpy as np
import pytest

import stable_worldmodel as swm
from stable_worldmodel.envs.gymnasium_robotics import FetchWrapper
from stable_worldmodel.envs.ogbench import CubeEnv, ExpertPolicy, MazeEnv, SceneEnv

DOMAINS = (
    *("acrobot", "ball_in_cup", "cartpole", "cheetah", "finger", "hopper"),
    *("humanoid", "manipulator", "pendulum", "quadruped", "reacher", "walker"),
)


@pytest.fixture(autouse=True, scope="module")
def assets():
    """Skips the tests of this module if the assets are not installed."""
    try:
        gymnasium.make("swm/PendulumDMControl-v0").close()
    except ValueError as error:
        if "swm assets" not in str(error):
            raise
        pytest.skip(str(error))


def same(one, other):
    assert one.keys() == other.keys()
    assert all(np.array_equal(np.asarray(one[key]), np.asarray(other[key]), equal_nan=True) for key in one)


def domain(name):
    module = importlib.import_module(f"stable_worldmodel.envs.dmcontrol.{name}")
    return getattr(module, module.__all__[0])


@pytest.mark.parametrize("name", DOMAINS)
def test_domains_of_dm_control_equal_the_registered_environments(name):
    kind = domain(name)
    env, registered = kind(), gymnasium.make(kind.id).unwrapped
    same(env.reset(seed=4)[1], registered.reset(seed=4)[1])
    for _ in range(3):
        action = env.action_space.sample()
        (_, reward, *_, info), (_, expected, *_, other) = env.step(action), registered.step(action)
        assert reward == expected
        same(info, other)
    assert env.render() is None
    assert kind(render_mode="rgb_array").render().shape == (224, 224, 3)


@pytest.mark.parametrize("name", [name for name in DOMAINS if "task" in inspect.signature(domain(name)).parameters])
def test_tasks_of_dm_control_are_options(name):
    kind = domain(name)
    (option,) = (one for one in swm.utils.describe(kind.id)["options"] if one["key"] == "task")
    default = inspect.signature(kind).parameters["task"].default
    assert default == option["values"][0]
    other = option["values"][-1]
    same(kind(task=other).reset(seed=1)[1], gymnasium.make(kind.id, task=other).reset(seed=1)[1])
    with pytest.raises(ValueError, match=default):
        kind(task="no-such-task")
    with pytest.raises(ValueError, match="environment_kwargs"):
        kind(environment_kwargs={"flat_observation": True})


def test_the_seed_of_the_constructor_is_that_of_the_first_episode():
    kind = domain("walker")
    env = kind(seed=5)
    first, second = env.reset()[0], env.reset()[0]
    assert np.array_equal(first, kind().reset(seed=5)[0]) and not np.array_equal(first, second)


def test_dm_control_renders_any_size_and_camera():
    env = domain("cheetah")(render_mode="rgb_array")
    env.reset(seed=0)
    assert env.render(width=64, height=48).shape == (48, 64, 3)
    cameras = swm.utils.describe(env.id)["cameras"]
    frames = [env.render(width=32, height=32, camera_id=camera) for camera in (0, cameras[0])]
    assert np.array_equal(*frames) and not np.array_equal(frames[0], env.render(32, 32, camera_id=len(cameras) - 1))
    with pytest.raises(ValueError, match="camera_id: 99"):
        env.render(camera_id=99)


@pytest.mark.parametrize(
    ("kind", "given", "name"),
    [
        (CubeEnv, {}, "swm/OGBCube-v0,env_type=single,ob_type=states"),
        (CubeEnv, {"env_type": "double"}, "swm/OGBCube-v0,env_type=double,ob_type=states"),
        (SceneEnv, {}, "swm/OGBScene-v0,ob_type=states"),
        (MazeEnv, {}, "swm/OGBMaze-v0,loco_env_type=point,maze_type=large,ob_type=states"),
        (MazeEnv, {"loco_env_type": "ant", "maze_type": "medium"}, "swm/OGBMaze-v0,loco_env_type=ant,maze_type=medium"),
    ],
)
def test_ogbench_environments_equal_the_registered_ones(kind, given, name):
    env = kind(**given)
    assert env.name.startswith(name)
    registered, _, options = env.name.partition(",")
    other = gymnasium.make(registered, **dict(option.split("=") for option in options.split(","))).unwrapped
    same(env.reset(seed=2)[1], other.reset(seed=2)[1])
    action = env.action_space.sample()
    same(env.step(action)[4], other.step(action)[4])
    assert env.render().shape == (224, 224, 3)


def test_ogbench_refuses_what_it_does_not_do():
    assert CubeEnv(height=48, width=48).render().shape == (48, 48, 3)
    for wrong in ({"permute_blocks": False}, {"width": 100}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            CubeEnv(**wrong)
    with pytest.raises(ValueError, match="env_type"):
        SceneEnv(env_type="cube")
    with pytest.raises(ValueError, match="single"):
        CubeEnv(env_type="nine")


@pytest.mark.parametrize("env", ["swm/OGBCube-v0", "swm/OGBScene-v0", "swm/OGBMaze-v0"])
def test_the_expert_of_ogbench_is_that_of_the_engine(env):
    actions = []
    for policy in (ExpertPolicy(seed=0), swm.policy.ExpertPolicy(seed=0)):
        world = swm.World(env, num_envs=2, image_shape=(16, 16))
        world.set_policy(policy)
        world.reset(seed=0)
        actions.append(policy.get_action(world.infos))
    assert np.array_equal(*actions) and np.abs(actions[0]).max() > 0


@pytest.mark.parametrize(
    ("given", "name", "is_dict"),
    [
        ({"env_id": "FetchPush-v3"}, "swm/FetchPush-v3", False),
        ({"env_id": "swm/FetchSlideDense-v3"}, "swm/FetchSlideDense-v3", False),
        ({"env_id": "FetchReach-v3", "flatten": False}, "swm/FetchReachDict-v3", True),
    ],
)
def test_fetch_environments_equal_the_registered_ones(given, name, is_dict):
    env, registered = FetchWrapper(**given, resolution=40, render_mode="rgb_array"), gymnasium.make(name).unwrapped
    (observation, info), (_, other) = env.reset(seed=3), registered.reset(seed=3)
    same(info, other)
    assert env.name == name and isinstance(observation, dict) == is_dict and env.render().shape == (40, 40, 3)
    with pytest.raises(ValueError, match="swm envs"):
        FetchWrapper("FetchFly-v3")


@pytest.mark.parametrize("make", [domain("hopper"), CubeEnv, lambda: FetchWrapper("FetchReach-v3")])
def test_environments_survive_pickling(make):
    env = make()
    env.reset(seed=0)
    twin = pickle.loads(pickle.dumps(env))
    action = env.action_space.sample()
    same(env.step(action)[4], twin.step(action)[4])
