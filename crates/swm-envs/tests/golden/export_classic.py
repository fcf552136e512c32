"""Records rollouts of the Python reference's classic control (pip install stable-worldmodel) in the layout of the other
golden files: long ones, to the ends of tracks and speeds, with actions outside their bounds.
Run: python export_classic.py FOLDER [ROLLOUTS]"""

import json
import sys

import gymnasium as gym
import numpy as np
from stable_worldmodel.envs.gymnasium_control.base import GymControlWrapper

FOLDER, ROLLOUTS = sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 12
WORLDS = {
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


def exact(world, state):
    """The start in the layout of the state, which is single precision: unstable worlds magnify what that loses."""
    state = np.asarray(state, np.float64)
    if world.startswith("swm/Pendulum"):
        return np.array([np.cos(state[0]), np.sin(state[0]), state[1]])
    if world.startswith("swm/Acrobot"):
        return np.array([f(state[i]) for i in (0, 1) for f in (np.cos, np.sin)] + [state[2], state[3]])
    return state


def act(world, env, state, rng):
    """Mostly what swings the world up or keeps it up, sometimes chance."""
    chance = rng.random() < 0.2
    if world.startswith("swm/CartPole"):
        return int(rng.integers(2)) if chance else int(state[2] + 0.3 * state[3] > 0)
    if world.startswith("swm/Acrobot"):
        return int(rng.integers(3)) if chance else int(2 * (state[5] > 0))
    if world.startswith("swm/MountainCarControl"):
        return int(rng.integers(3)) if chance else int(2 * (state[1] > 0))
    action = 5 * rng.uniform(-1, 1) if chance else 3 * np.sign(state[-1]) * rng.random()
    return np.array([action], np.float32)


for world, steps in WORLDS.items():
    env = gym.make(world, render_mode="rgb_array")
    while not isinstance(env, GymControlWrapper):
        env = env.env
    for seed in range(1, ROLLOUTS + 1):
        rng = np.random.default_rng(seed)
        _, info = env.reset(seed=seed, options={"variation": ["all"]} if seed % 2 else None)
        states, actions, rewards, terminations = [info["state"]], [], [], []
        start, first = exact(world, env.unwrapped.state), env.render()
        for _ in range(steps):
            action = act(world, env, states[-1], rng)
            _, reward, terminated, _, info = env.step(action)
            states.append(info["state"])
            actions.append(action)
            rewards.append(reward)
            terminations.append(terminated)
        np.savez_compressed(
            f"{FOLDER}/{world.replace('/', '_')}-more-{seed}.npz",
            action=np.array(actions),
            reward=np.array(rewards, np.float64),
            terminated=np.array(terminations),
            frame_first=first,
            frame_last=env.render(),
            variation=json.dumps(plain(env.variation_space.value)),
            start=start,
            **{"info.state": np.array(states, np.float64)},
        )
