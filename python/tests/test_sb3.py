"""Tests that Stable-Baselines3 trains on the native environments without adapters."""

import numpy as np
import pytest

import stable_worldmodel  # noqa: F401 - registers the environments

torch = pytest.importorskip("torch")
sb3 = pytest.importorskip("stable_baselines3")

from stable_baselines3.common.env_util import make_vec_env  # noqa: E402
from stable_baselines3.common.evaluation import evaluate_policy  # noqa: E402

torch.set_num_threads(1)


def envs(name, count, **options):
    return make_vec_env(name, n_envs=count, seed=0, env_kwargs={"max_episode_steps": 200, **options})


def test_ppo_learns_to_balance_a_pole():
    model = sb3.PPO(
        "MlpPolicy",
        envs("swm/CartPoleControl-v1", 4),
        n_steps=64,
        batch_size=256,
        n_epochs=20,
        gamma=0.98,
        gae_lambda=0.8,
        learning_rate=2e-3,
        seed=0,
    )

    def reward():
        return evaluate_policy(model, envs("swm/CartPoleControl-v1", 4), n_eval_episodes=12, deterministic=False)[0]

    # The untrained model acts nearly at random.
    before = reward()
    model.learn(4096)
    after = reward()
    assert before < 40 and after > 100, (before, after)


def test_sac_runs_on_continuous_actions():
    model = sb3.SAC("MlpPolicy", envs("swm/PendulumControl-v1", 2), learning_starts=32, seed=0, buffer_size=500)
    model.learn(96)
    action, _ = model.predict(model.env.reset())
    assert action.shape == (2, 1) and np.isfinite(action).all()


@pytest.mark.parametrize("name", ["swm/PushT-v1", "swm/PushT-Discrete-v1"])
def test_ppo_trains_on_dict_observations(name):
    model = sb3.PPO("MultiInputPolicy", envs(name, 2), n_steps=8, batch_size=16, n_epochs=1, seed=0)
    model.learn(32)
    observation = model.env.reset()
    assert set(observation) == {"proprio", "state"} and len(model.predict(observation)[0]) == 2


def test_sb3_env_checker_passes():
    import gymnasium
    from stable_baselines3.common.env_checker import check_env

    for name in ("swm/TwoRoom-v1", "swm/CartPoleControl-v1", "swm/PushT-v1"):
        check_env(gymnasium.make(name), warn=False)
