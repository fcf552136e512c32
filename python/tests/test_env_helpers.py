"""Tests of helpers of environments: cameras, colours, read-outs of Push-T, policies of Stable-Baselines3, Craftax's classes."""

import os
import pickle
import sys
from collections import namedtuple
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

from stable_worldmodel.envs import utils
from stable_worldmodel.envs.dmcontrol.dmcontrol import get_obs_shape
from stable_worldmodel.envs.pusht import PushT


def test_cameras_are_turned_about_the_axes_of_the_world():
    axes = (0.0, 1.0, 0.0, -0.6, 0.0, 0.8)
    assert utils.perturb_camera_angle(axes, [0, 0]) == axes
    # A quarter about z takes x to y, and y to -x; then a quarter about x takes y to z.
    assert np.allclose(utils.perturb_camera_angle(axes, [90, 0]), [-1, 0, 0, 0, -0.6, 0.8])
    assert np.allclose(utils.perturb_camera_angle(axes, [90, 90]), [-1, 0, 0, 0, -0.8, -0.6])
    x, y = np.reshape(utils.perturb_camera_angle(axes), (2, 3))
    assert np.allclose([x @ x, y @ y, x @ y], [1, 1, 0]) and 0.99 < x[1] < 1


def test_points_and_colours(monkeypatch):
    surface = SimpleNamespace(get_height=lambda: 100)
    assert utils.to_pygame((3.4, 7.6), surface) == (3, 8)
    monkeypatch.setattr(utils, "positive_y_is_up", True)
    assert utils.to_pygame((3.4, 7.6), surface) == (3, 92) and utils.from_pygame((3, 92), surface) == (3, 8)
    color = namedtuple("Color", "r g b a")(100, 200, 250, 255)
    assert utils.light_color(color) == type(color)(120, 240, 255, 255)


def test_sizes_of_observations_are_added_up():
    specs = {"a": SimpleNamespace(shape=(2, 3)), "b": SimpleNamespace(shape=()), "c": 1.0}
    assert get_obs_shape(SimpleNamespace(observation_spec=lambda: specs)) == (8,)


def test_push_t_is_read_and_set():
    env = PushT()
    env.reset(seed=0)
    observation, *_, info = env.step(env.action_space.sample())
    state, goal = info["state"], info["goal_state"]
    assert all(np.array_equal(env._get_obs()[key], value) for key, value in observation.items())
    assert all(np.array_equal(env._get_info()[key], value) for key, value in info.items()) and info["env_name"] == "PushT"
    assert np.allclose([*env.agent.position, *env.block.position, env.block.angle, *env.agent.velocity], state)
    assert np.array_equal(env.goal_state, goal) and np.array_equal(env.goal_pose, goal[2:5])
    moved = state.copy()
    moved[:2] = 100, 200
    env._set_state(moved)
    assert env.agent.position == (100, 200) and np.array_equal(env.goal_state, goal)
    env._set_goal_state(moved)
    assert np.array_equal(env.goal_state, moved) and env._get_info()["success"]


@pytest.fixture
def trained(tmp_path):
    """An untrained policy of SAC and statistics of observations, as Stable-Baselines3 saves them."""
    pytest.importorskip("stable_baselines3")
    from stable_baselines3 import SAC
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
    from torch import nn

    env = VecNormalize(DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")]))
    model = SAC("MlpPolicy", env, seed=0, device="cpu", policy_kwargs={"net_arch": [8, 6], "activation_fn": nn.Tanh})
    env.reset()
    for _ in range(5):
        env.step(np.array([[0.5]]))
    model.save(tmp_path / "sac.zip")
    env.save(str(tmp_path / "normalize.pkl"))
    return tmp_path, model, env


def test_policies_of_stable_baselines3_act(trained):
    from stable_worldmodel.envs.dmcontrol import ExpertPolicy
    from stable_worldmodel.envs.dmcontrol.expert_policy import SB3Normalizer

    folder, model, env = trained
    observations = np.random.default_rng(0).normal(size=(2000, 3)).astype(np.float32)
    normalized = env.normalize_obs(observations)
    normalizer = SB3Normalizer(folder / "normalize.pkl")
    assert np.allclose(normalizer(observations), normalized, atol=1e-5) and np.abs(normalizer(1e9 * observations)).max() == 10
    policy = ExpertPolicy(folder / "sac.zip", folder / "normalize.pkl", seed=1)
    # The actions of Pendulum are twice those of the network.
    expected, _ = model.predict(normalized, deterministic=True)
    mean, log_std = policy.model(model.policy.obs_to_tensor(normalized)[0].float()).chunk(2, -1)
    assert np.allclose(2 * mean.tanh().numpy(), expected, atol=1e-4)
    actions = policy.get_action({"observation": observations[:, None]})
    assert actions.shape == (2000, 1) and actions.dtype == np.float32
    drawn = (np.arctanh(actions.clip(-0.999, 0.999)) - mean.numpy()) / log_std.exp().numpy()
    assert abs(drawn.mean()) < 0.1 and 0.8 < drawn.std() < 1.1
    again = ExpertPolicy(folder / "sac.zip", folder / "normalize.pkl", seed=1)
    assert np.array_equal(again.get_action({"observation": observations}), actions)
    noisy = ExpertPolicy(folder / "sac.zip", folder / "normalize.pkl", noise_std=0.5, seed=1)
    difference = noisy.get_action({"observation": observations}) - actions
    assert 0.1 < difference.std() < 0.6
    with pytest.raises(KeyError, match="observation"):
        policy.get_action({})


class Ran(Exception):
    pass


def run(*arguments):
    raise Ran


class Hostile:
    """Runs a function when it is unpickled."""

    def __reduce__(self):
        return run, ()


def test_files_of_policies_are_read_as_data(trained):
    import zipfile

    import torch

    from stable_worldmodel.envs.dmcontrol import ExpertPolicy
    from stable_worldmodel.envs.dmcontrol.expert_policy import SB3Normalizer

    folder, _, _ = trained
    bad = folder / "bad.pkl"
    bad.write_bytes(pickle.dumps(Hostile()))
    with pytest.raises(ValueError, match="no statistics of VecNormalize"):
        SB3Normalizer(bad)
    bad.write_bytes(b"text")
    with pytest.raises(ValueError, match="no statistics of VecNormalize"):
        SB3Normalizer(bad)
    # Bytes are never taken for objects, and an index of 2**31 - 1 in the memo of a pickle reserves no memory.
    objects = np.array([None, "text"], object)
    bad.write_bytes(pickle.dumps(SimpleNamespace(obs_rms=SimpleNamespace(mean=objects, var=objects))))
    with pytest.raises(ValueError, match="a mean of shape"):
        SB3Normalizer(bad)
    bad.write_bytes(b"\x80\x04Nr\xff\xff\xff\x7f.")
    with pytest.raises(ValueError, match="no statistics of VecNormalize"):
        SB3Normalizer(bad)
    # Lists that contain the list before them twice, as the name of a type and as statistics: 2**60 numbers in 400 bytes.
    nested = b"]q\x00K\x01a0" + b"".join(b"(h%ch%clq%c0" % (i, i, i + 1) for i in range(60)) + b"h\x3c"
    record = b"cbuiltins\nX\n)R}"
    statistics = record + b"X\x04\x00\x00\x00mean" + nested + b"sX\x03\x00\x00\x00varK\x01sb"
    for content in (
        b"cnumpy\ndtype\n" + nested + b"\x85R",
        record + b"X\x07\x00\x00\x00obs_rms" + statistics + b"sb",
        b"\x96\x00\x00\x00\x00\x00\x01\x00\x00x",
    ):
        bad.write_bytes(b"\x80\x05" + content + b".")
        with pytest.raises(ValueError, match="no statistics of VecNormalize"):
            SB3Normalizer(bad)
    os.mkfifo(folder / "pipe")
    with pytest.raises(ValueError, match="not a regular file"):
        SB3Normalizer(folder / "pipe")
    with open(folder / "large", "wb") as file:
        file.truncate(1 << 30)
    with pytest.raises(ValueError, match="16777216 bytes"):
        SB3Normalizer(folder / "large")
    layer = {"bias": torch.zeros(1), "weight": torch.zeros(1, 1)}
    actor = {f"actor.{name}.{part}": layer[part] for name in ("latent_pi.0", "mu", "log_std") for part in layer}
    repeated = actor | {"actor.latent_pi.0.weight": torch.zeros(1).expand(1 << 16, 1 << 16)}
    for content, data in (
        (Hostile(), "{}"),
        ({"critic.qf0.0.weight": torch.zeros(1)}, "{}"),
        (repeated, "{}"),
        ({**actor, "actor.mu.bias": 1}, "{}"),
        (actor, "[]"),
        (actor, '{"policy_kwargs": [1]}'),
        (actor, " " * (64 << 20) + "{}"),
    ):
        with zipfile.ZipFile(folder / "bad.zip", "w", zipfile.ZIP_DEFLATED) as archive:
            with archive.open("policy.pth", "w") as file:
                torch.save(content, file)
            archive.writestr("data", data)
        with pytest.raises(ValueError, match="SAC"):
            ExpertPolicy(folder / "bad.zip", folder / "normalize.pkl")
    with pytest.raises(ValueError, match="no model of Stable-Baselines3"):
        ExpertPolicy(bad, folder / "normalize.pkl")


class FakeCraftax(gymnasium.Env):
    """An environment as that of the bridge, without JAX."""

    def __init__(self):
        self.observation_space = gymnasium.spaces.Box(0.0, 1.0, (1345,), np.float32)
        self.action_space = gymnasium.spaces.Discrete(17)

    def reset(self, *, seed=None, options=None):
        self.seed = seed
        return np.zeros(1345, np.float32), {}

    def step(self, action):
        return np.full(1345, action, np.float32), 1.0, action == 3, False, {"score": np.float32(action)}

    def render(self):
        return np.zeros((63, 63, 3), np.uint8)


def test_classes_of_craftax_are_the_environments_of_the_bridge(monkeypatch):
    from stable_worldmodel import _engine
    from stable_worldmodel.envs import craftax

    id = "swm/CraftaxClassicSymbolic-v1"
    spec = gymnasium.envs.registration.EnvSpec(id, entry_point=FakeCraftax)
    module = SimpleNamespace(register=lambda: monkeypatch.setitem(gymnasium.registry, id, spec))
    monkeypatch.setattr(_engine, "bridge", lambda with_craftax: monkeypatch.setitem(sys.modules, "swm_craftax", module))
    env = craftax.CraftaxClassicSymbolicWrapper(seed=5, render_mode="rgb_array")
    assert env.reset()[1] == {"env_name": "CraftaxClassicSymbolicWrapper"} and env._env.seed == 5
    assert env.reset()[1] == env.info and env._env.seed is None
    observation, reward, terminated, truncated, info = env.step(2)
    assert observation[0] == 2 and reward == 1 and not terminated and not truncated
    assert info == {"env_name": "CraftaxClassicSymbolicWrapper", "score": 2} and env.unwrapped is env
    assert env.render().shape == (63, 63, 3) and craftax.CraftaxClassicSymbolicWrapper().render() is None
    with pytest.raises(ValueError, match="obs_shape"):
        craftax.CraftaxWrapper("Craftax-Classic-Symbolic-v1", (3,))
    with pytest.raises(ValueError, match="unknown.*CraftaxClassicSymbolic"):
        craftax.CraftaxPixelsWrapper()
    with pytest.raises(ValueError, match="backend"):
        craftax.CraftaxClassicSymbolicWrapper(backend="cpu")


def test_craftax_says_what_to_install(monkeypatch):
    from stable_worldmodel import _engine
    from stable_worldmodel.envs import craftax

    def missing(with_craftax):
        raise ModuleNotFoundError("No module named 'jax'")

    monkeypatch.setattr(_engine, "bridge", missing)
    with pytest.raises(ModuleNotFoundError, match=r"stable-worldmodel-rs\[craftax\]"):
        craftax.CraftaxPixelsWrapper()
