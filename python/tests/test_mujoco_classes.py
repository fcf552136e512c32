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


def unnamed(info):
    """Infos without the name of the environment."""
    return {key: value for key, value in info.items() if key != "env_name"}


def same(one, other):
    """Asserts that infos are equal. Those of the classes have the environment's name as well."""
    one, other = unnamed(one), unnamed(other)
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


def current(env):
    """The infos of the current state."""
    return env._get_info()


@pytest.mark.parametrize("name", DOMAINS)
def test_states_of_dm_control_are_read_and_set(name):
    env = domain(name)()
    env.reset(seed=1)
    for _ in range(4):
        *_, info = env.step(env.action_space.sample())
    assert env.info["env_name"] == info["env_name"] == domain(name).__name__.removesuffix("DMControlWrapper")
    same(info, env.info)
    qpos, qvel = info["qpos"].copy(), 0.5 * info["qvel"]
    qpos[-1] += 0.1
    env.set_state(qpos, qvel)
    assert np.array_equal(env.info["qpos"], qpos) and np.array_equal(env.info["qvel"], qvel)
    assert np.array_equal(env.info["goal_state"], info["goal_state"])
    for wrong in ((qpos[1:], qvel), (qpos, np.full_like(qvel, np.nan))):
        with pytest.raises(ValueError):
            env.set_state(*wrong)
    with pytest.raises(ValueError, match="environment_kwargs"):
        env.compile_model(environment_kwargs={"flat_observation": True})


def test_factors_are_changed_in_an_episode_or_for_the_next():
    env = domain("walker")()
    env.reset(seed=1)
    env.step(env.action_space.sample())
    before, color = env.info, np.array([0.1, 0.2, 0.3])
    env.set_gravity([0, 0, -5.0])
    env.variation_space["agent"]["color"].set_value(color)
    assert not np.array_equal(env._env.factors()["agent.color"], color)
    env.apply_runtime_variations()
    assert np.array_equal(env._env.factors()["agent.color"], color) and env._env.factors()["gravity.z"] == [-5.0]
    same(before, env.info)
    env.compile_model(seed=3)
    assert np.array_equal(env.variation_space["agent"]["color"].value, color) and env.info["score"] == 0
    env.mark_dirty()
    env.reset(seed=3)
    assert env.variation_space["gravity"]["z"].value == [-9.81]
    for gravity in ([0, 0, 50.0], [0, 0]):
        with pytest.raises(ValueError):
            env.set_gravity(gravity)
    with pytest.raises(ValueError, match="no factors of gravity"):
        domain("finger")().set_gravity([0, 0, -5])


def test_the_reacher_matches_positions():
    env = domain("reacher")(task="qpos_match")
    _, info = env.reset(seed=0, options={"target_qpos": [0.3, 0.4]})
    assert np.array_equal(info["goal_state"], [0.3, 0.4, 0, 0]) and not info["success"]
    env.set_state([0.3, 0.4], [0, 0])
    assert env.info["success"]
    env.set_target_qpos([1.3, 0.4])
    assert not env.info["success"]
    with pytest.raises(ValueError, match="expected \\(2,\\)"):
        env.set_target_qpos([1.3])
    with pytest.raises(ValueError, match="qpos_match"):
        domain("reacher")().set_target_qpos([0, 0])


@pytest.mark.parametrize(
    ("kind", "options"),
    [(CubeEnv, {"env_type": "double", "reward_task_id": 2}), (CubeEnv, {"multiview": True}), (SceneEnv, {"reward_task_id": 1})],
)
def test_read_outs_of_tables_are_those_of_steps(kind, options):
    env = kind(**options)
    env.reset(seed=0)
    for _ in range(6):
        observation, reward, *_, info = env.step(env.action_space.sample())
        assert np.array_equal(env.compute_observation(), observation) and env.compute_reward() == reward
    found = env.get_step_info()
    assert found["env_name"] == info["env_name"] == type(env).__name__.removesuffix("Env")
    same(info, found)
    same(info, env.get_reset_info())
    objects = {}
    env.add_object_info(objects)
    assert np.array_equal(objects["privileged/block_0_pos"], info["privileged/block_0_pos"])
    # The oracle sees the objects as the observation does: cubes follow the arm, the drawer and the window are last.
    oracle = env.compute_oracle_observation()
    assert np.allclose(oracle[:3], observation[19:22])
    if isinstance(env, SceneEnv):
        assert np.array_equal(oracle[3:5], info["button_states"]) and np.allclose(oracle[5:], observation[[36, 38]])
    frames = env.render_multiview()
    if env._multiview:
        assert np.array_equal(frames["front_pixels"], env.render()) and not np.array_equal(*frames.values())
    else:
        assert np.array_equal(frames, env.render("front_pixels"))
    assert not np.array_equal(env.render("side_pixels"), env.render())
    with pytest.raises(TypeError, match="camera"):
        env.render("front", 64)


def test_goals_of_cubes_are_set():
    env = CubeEnv("double")
    env.reset(seed=0)
    before = current(env)
    observation, info = env.set_new_target()
    assert np.array_equal(info["state"], before["state"]) and np.array_equal(observation, env.compute_observation())
    assert (
        not np.array_equal(info["goal/block_pos"], before["goal/block_pos"]) and env.set_new_target(return_info=False) is None
    )
    env.set_target_pos(1, before["privileged/block_1_pos"], before["privileged/block_1_quat"])
    env.set_target_pos(0, before["privileged/block_0_pos"] + [0.2, 0, 0])
    assert np.allclose(current(env)["goal/block_yaw"][1], before["privileged/block_1_yaw"]) and env.compute_reward() == 0
    env.set_target_pos(0, before["privileged/block_0_pos"])
    assert env.compute_reward() == 1 and current(env)["success"]
    for wrong in ((2, [0, 0, 0]), (0, [0, 0])):
        with pytest.raises(ValueError):
            env.set_target_pos(*wrong)


def test_goals_and_states_of_scenes_are_set():
    env = SceneEnv(reward_task_id=1)
    env.reset(seed=0)
    now = current(env)
    # Buttons that hold, and a drawer and a window at their goals, all but the cube.
    qpos = now["qpos"].copy()
    qpos[23:25] = -0.16, 0.2
    env.set_state(qpos, 0 * now["qvel"], button_state_0=1, button_state_1=0)
    env.set_cube_target_pos(0, now["privileged/block_0_pos"] + [0.2, 0, 0])
    for button, state in ((0, 1), (1, 0)):
        env.set_target_button_state(button, state)
    env.set_target_drawer_pos(-0.16)
    env.set_target_window_pos(0.2)
    now = current(env)
    assert list(now["button_states"]) == list(now["goal/button_states"]) == [1, 0]
    assert now["privileged/drawer_pos"] == now["goal/drawer_pos"] == -0.16
    assert now["privileged/window_pos"] == now["goal/window_pos"] == 0.2
    assert env.compute_reward() == -1 and not now["success"]
    env.set_cube_target_pos(0, now["privileged/block_0_pos"])
    assert env.compute_reward() == 0 and current(env)["success"]
    env.set_target_window_pos(0.0)
    assert env.compute_reward() == -1
    for wrong in ((2, 0), (0, 2)):
        with pytest.raises(ValueError):
            env.set_target_button_state(*wrong)
    with pytest.raises(TypeError, match="button_state_0"):
        env.set_state(qpos, now["qvel"], button_state_7=1)
    # Options come first, as in the reference.
    assert np.array_equal(env.reset({"variation": ["cube"]}, seed=2)[0], env.reset(options={"variation": ["cube"]}, seed=2)[0])


def test_mazes_are_changed():
    env = MazeEnv()
    env.reset(seed=0)
    position = current(env)["xy"] + [0.3, 0.1]
    env.set_state(position, [0, 0])
    assert current(env)["env_name"] == "PointMaze"
    assert np.allclose(current(env)["xy"], position)
    env.variation_space["wall"]["color"].set_value(np.array([0.1, 0.2, 0.3]))
    env.mark_dirty()
    env.compile_model()
    assert np.allclose(env._env.factors()["wall.color"], [0.1, 0.2, 0.3])
