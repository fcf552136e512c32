"""Records rollouts of the Python reference's classic control (pip install stable-worldmodel) in the layout of the other
golden files. The rollouts are long enough to reach the bounds of positions and speeds, and some actions are out of
bounds.
Run: python export_classic.py FOLDER [ROLLOUTS]"""

import json
import sys

import gymnasium as gym
import numpy as np
from stable_worldmodel.envs.gymnasium_control.base import GymControlWrapper

FOLDER, ROLLOUTS = sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 12
STEPS = {
    "swm/CartPoleControl-v1": 60,
    "swm/MountainCarControl-v0": 200,
    "swm/MountainCarContinuousControl-v0": 200,
    "swm/AcrobotControl-v1": 80,
    "swm/PendulumControl-v1": 150,
}


def plain(value):
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    return np.asarray(value).tolist()


def exact(env_id, state):
    """Returns the start in the layout of the `state` column, in double precision.

    The column is in single precision, and unstable environments amplify the rounding error."""
    state = np.asarray(state, np.float64)
    if env_id.startswith("swm/Pendulum"):
        return np.array([np.cos(state[0]), np.sin(state[0]), state[1]])
    if env_id.startswith("swm/Acrobot"):
        return np.array([f(state[i]) for i in (0, 1) for f in (np.cos, np.sin)] + [state[2], state[3]])
    return state


def act(env_id, env, state, rng):
    """Returns an action that swings the system up or holds it, and a random one with probability 0.2."""
    is_random = rng.random() < 0.2
    if env_id.startswith("swm/CartPole"):
        return int(rng.integers(2)) if is_random else int(state[2] + 0.3 * state[3] > 0)
    if env_id.startswith("swm/Acrobot"):
        return int(rng.integers(3)) if is_random else int(2 * (state[5] > 0))
    if env_id.startswith("swm/MountainCarControl"):
        return int(rng.integers(3)) if is_random else int(2 * (state[1] > 0))
    action = 5 * rng.uniform(-1, 1) if is_random else 3 * np.sign(state[-1]) * rng.random()
    return np.array([action], np.float32)


for env_id, steps in STEPS.items():
    env = gym.make(env_id, render_mode="rgb_array")
    while not isinstance(env, GymControlWrapper):
        env = env.env
    for seed in range(1, ROLLOUTS + 1):
        rng = np.random.default_rng(seed)
        _, info = env.reset(seed=seed, options={"variation": ["all"]} if seed % 2 else None)
        states, actions, rewards, terminations = [info["state"]], [], [], []
        start, first = exact(env_id, env.unwrapped.state), env.render()
        for _ in range(steps):
            action = act(env_id, env, states[-1], rng)
            _, reward, terminated, _, info = env.step(action)
            states.append(info["state"])
            actions.append(action)
            rewards.append(reward)
            terminations.append(terminated)
        np.savez_compressed(
            f"{FOLDER}/{env_id.replace('/', '_')}-more-{seed}.npz",
            action=np.array(actions),
            reward=np.array(rewards, np.float64),
            terminated=np.array(terminations),
            frame_first=first,
            frame_last=env.render(),
            variation=json.dumps(plain(env.variation_space.value)),
            start=start,
            **{"info.state": np.array(states, np.float64)},
        )
