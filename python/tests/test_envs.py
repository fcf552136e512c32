"""Tests of the native environments as Gymnasium environments."""

import copy
import pickle
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import stable_worldmodel as swm

#: Accepted warnings of Gymnasium's checker: the environments keep the spaces that other libraries define for them.
ADVICE = ("we recommend using a symmetric and normalized space", "probably too low", "probably too high")


def make(name, **options):
    """Creates an environment; skips the test if its assets are not installed."""
    try:
        return gymnasium.make(name, **options)
    except ValueError as error:
        if "swm assets" not in str(error):
            raise
        pytest.skip(str(error))


def same(one, other):
    assert type(one) is type(other)
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            same(one[key], other[key])
    elif isinstance(one, tuple):
        for pair in zip(one, other, strict=True):
            same(*pair)
    else:
        assert np.array_equal(one, other)


@pytest.mark.parametrize("name", swm.envs.ids())
def test_gymnasium_env_checker_passes(name):
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        env = make(name, render_mode="rgb_array")
        check_env(env.unwrapped)
    found = [str(one.message) for one in found]
    assert [one for one in found if not any(advice in one for advice in ADVICE)] == []


@pytest.mark.parametrize("name", swm.envs.ids())
def test_episode_depends_only_on_its_seed(name):
    one, other = (make(name, render_mode="rgb_array", image_shape=(40, 48)) for _ in range(2))
    assert one.spec.id == name and one.unwrapped.max_episode_steps > 0
    for env in (one, other):
        env.action_space.seed(3)
    same(one.reset(seed=7), other.reset(seed=7))
    assert one.unwrapped.variation_space.value.keys() == other.unwrapped.variation_space.value.keys()
    for _ in range(5):
        same(one.step(one.action_space.sample()), other.step(other.action_space.sample()))
    image = one.render()
    assert image.shape == (40, 48, 3) and image.dtype == np.uint8 and image.std() > 0
    assert np.array_equal(image, other.render())
    assert one.unwrapped.render_goal().shape == (40, 48, 3)
    # Without a seed, the next episode differs, and the last seed determines it.
    (first, _), (second, _) = one.reset(), one.reset()
    same(first, other.reset()[0])
    with pytest.raises(AssertionError):
        same(first, second)
    for env in (one, other):
        env.close()


@pytest.mark.parametrize("name", ["swm/TwoRoom-v1", "swm/PushT-v1", "swm/CartPoleControl-v1"])
@pytest.mark.parametrize("mode", ["sync", "async"])
def test_vector_environments_match_single_environments(name, mode):
    envs = gymnasium.make_vec(name, num_envs=3, vectorization_mode=mode)
    try:
        observations, infos = envs.reset(seed=4)
        alone = gymnasium.make(name)
        expected, info = alone.reset(seed=5)
        second = {key: value[1] for key, value in observations.items()} if isinstance(expected, dict) else observations[1]
        same({"observation": second}, {"observation": expected})
        assert infos["goal_distance"][1] == info["goal_distance"]
        envs.action_space.seed(0)
        for _ in range(3):
            observations, rewards, terminated, truncated, _ = envs.step(envs.action_space.sample())
        assert envs.observation_space.contains(observations) and rewards.shape == (3,)
    finally:
        envs.close()


def test_reset_options_choose_factors_and_the_initial_state():
    env = gymnasium.make("swm/PushT-v1", render_mode="rgb_array", image_shape=(32, 32))
    _, info = env.reset(seed=0, options={"variation": ["agent.color"], "variation_values": {"block.scale": 40}})
    value = env.unwrapped.variation_space.value
    assert value["block"]["scale"] == 40 and env.unwrapped.variation_space.check()
    env.reset(seed=1, options={"variation": ["agent.color"]})
    other = env.unwrapped.variation_space.value
    assert not np.array_equal(value["agent"]["color"], other["agent"]["color"]) and other["block"]["scale"] == 30
    state = [100.0, 200.0, 256.0, 256.0, 1.0, 0.0, 0.0]
    observation, _ = env.reset(seed=2, options={"state": state})
    assert np.allclose(observation["state"], state, atol=1)
    with pytest.raises(ValueError, match="agent.color"):
        env.reset(options={"variation": ["agent.colour"]})


def test_variation_space_that_a_program_holds_has_the_values_of_the_current_episode():
    env = gymnasium.make("swm/TwoRoom-v1", image_shape=(32, 32)).unwrapped
    color = env.variation_space["agent"]["color"]
    seen, snapshots, rows = [], [], []
    for seed in (1, 2):
        _, info = env.reset(seed=seed, options={"variation": ["agent.color"]})
        seen.append(color.value.tolist())
        assert seen[-1] == list(env._env.factors()["agent.color"])
        snapshots.append(env.snapshot())
        rows.append({"state": info["state"], "variation_agent_color": color.value.astype(np.float32)})
    assert seen[0] != seen[1]
    env.restore(snapshots[0])
    assert color.value.tolist() == seen[0]
    env.restore_from(rows[1], rows[1])
    assert color.value.tolist() == seen[1]
    # The values that a program sets stay until the next episode.
    color.set_value(np.array([1, 2, 3], np.uint8))
    env.step(env.action_space.sample())
    assert env.variation_space["agent"]["color"].value.tolist() == [1, 2, 3]
    env.reset(seed=1, options={"variation": ["agent.color"]})
    assert color.value.tolist() == seen[0]


def test_unknown_keyword_arguments_and_render_modes_raise():
    with pytest.raises(ValueError, match="no_such_option"):
        gymnasium.make("swm/PushT-v1", no_such_option=3)
    with pytest.raises(ValueError, match="rgb_array"):
        swm.envs.NativeEnv("swm/PushT-v1", render_mode="human")


def test_copy_has_the_options_of_the_environment():
    env = make("swm/OGBCube-v0", env_type="double").unwrapped
    env.reset(seed=0)
    twin = copy.deepcopy(env)
    assert twin.name == "swm/OGBCube-v0,env_type=double" and twin.observation_space == env.observation_space


def test_time_limit_of_gymnasium_truncates():
    env = gymnasium.make("swm/TwoRoom-v1", max_episode_steps=3)
    env.reset(seed=0)
    assert [env.step(np.zeros(2, np.float32))[3] for _ in range(3)] == [False, False, True]


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
@pytest.mark.parametrize("name", swm.envs.ids())
def test_copy_continues_from_the_same_state(name, copied):
    env = make(name, render_mode="rgb_array", image_shape=(24, 24)).unwrapped
    env.reset(seed=3)
    env.step(env.action_space.sample())
    twin = copied(env)
    assert np.array_equal(env.render(), twin.render())
    action = env.action_space.sample()
    same(env.step(action), twin.step(action))
    same(env.reset(), twin.reset())


def test_wrong_actions_raise_errors_with_the_reason():
    env = swm.envs.NativeEnv("swm/TwoRoom-v1")
    env.reset(seed=0)
    with pytest.raises(ValueError, match="2"):
        env.step(np.zeros(3, np.float32))
    with pytest.raises(ValueError, match="finite"):
        env.step(np.array([np.nan, 0], np.float32))
    cart = swm.envs.NativeEnv("swm/CartPoleControl-v1")
    cart.reset(seed=0)
    cart.step(1)
    cart.step(np.int64(0))
    with pytest.raises(ValueError, match=r"0\.\.=1"):
        cart.step(7)


def test_actions_that_a_conversion_would_change_are_refused():
    cart, rooms = swm.envs.NativeEnv("swm/CartPoleControl-v1"), swm.envs.NativeEnv("swm/TwoRoom-v1")
    for env in (cart, rooms):
        env.reset(seed=0)
    for action in (1.7, np.array([0.5]), np.nan, np.inf, np.array([0.5], object)):
        with pytest.raises(ValueError, match="step: expected whole numbers"):
            cart.step(action)
    for env, action in ((cart, "1"), (cart, [b"1"]), (cart, 1 + 0j), (rooms, ["0.5", "0"]), (rooms, [0.5 + 1j, 0])):
        with pytest.raises(ValueError, match="step: expected real actions"):
            env.step(action)
    for env, action in ((rooms, np.array(["0.5", 0], object)), (rooms, [None, 0.5]), (rooms, None), (cart, None)):
        with pytest.raises(ValueError, match="step: expected real actions"):
            env.step(action)
    # Whole numbers in another type, and other real numbers, are the same actions.
    for env, one, others in (
        (cart, 1, (1.0, np.array([1.0], np.float32), np.uint8(1), np.array([1], object))),
        (rooms, [0.5, 0.0], (np.array([0.5, 0]), np.array([0.5, 0], object))),
    ):
        env.reset(seed=0)
        expected = env.step(one)[4]["state"].tolist()
        for other in others:
            env.reset(seed=0)
            assert env.step(other)[4]["state"].tolist() == expected


IMPORTS = [
    "import gymnasium; import stable_worldmodel",
    "import stable_worldmodel; import gymnasium",
    "import stable_worldmodel as swm; swm.envs.ids(); import gymnasium",
    "import stable_worldmodel as swm; swm.World; import gymnasium",
    "import stable_worldmodel, stable_worldmodel; import gymnasium as g; import gymnasium",
]


def test_environments_are_registered_in_any_import_order():
    check = "gymnasium.make('swm/TwoRoom-v1').reset(seed=0)"
    children = [
        subprocess.Popen([sys.executable, "-W", "error", "-c", f"{line}; {check}"], stderr=subprocess.PIPE, text=True)
        for line in IMPORTS
    ]
    for line, child in zip(IMPORTS, children, strict=True):
        _, complaint = child.communicate(timeout=60)
        assert child.returncode == 0 and complaint == "", (line, complaint)
    # Gymnasium imports the module that an id names.
    alone = "import gymnasium; gymnasium.make('stable_worldmodel:swm/TwoRoom-v1').reset(seed=0)"
    assert subprocess.run([sys.executable, "-c", alone], timeout=60).returncode == 0
