"""Records Two-Room rollouts of the Python reference (pip install stable-worldmodel) that bump into walls and walk
through doors, in the layout of the other golden files. Run in this folder: python export_two_room.py"""

import json

import numpy as np
from stable_worldmodel.envs.two_room.env import TwoRoomEnv

STEPS = 200


def plain(value):
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    return np.asarray(value).tolist()


for seed in range(1, 7):
    env = TwoRoomEnv()
    rng = np.random.default_rng(seed)
    observation, info = env.reset(seed=seed, options={"variation": ["all"]})
    rows = {"obs": [observation.numpy()], "proprio": [info["proprio"]], "state": [info["state"]],
            "goal_state": [info["goal_state"]], "distance_to_target": [info["distance_to_target"]]}
    actions, rewards, terminations = [], [], []
    first = env.render()
    for step in range(STEPS):
        if step % 20 == 0:
            doors = observation.numpy()[4:].reshape(3, 2)[: env.num_doors]
            aim = doors[rng.integers(len(doors))] if rng.random() < 0.6 else rng.uniform(0, 224, 2)
        away = aim - info["state"]
        if step % 20 > 9 and np.abs(away).max() < 12:
            aim = aim + rng.uniform(-80, 80, 2)
        action = (1.3 * away / max(np.linalg.norm(away), 1e-6) + rng.normal(0, 0.2, 2)).astype(np.float32)
        observation, reward, terminated, _, info = env.step(action)
        actions.append(action)
        rewards.append(reward)
        terminations.append(terminated)
        rows["obs"].append(observation.numpy())
        for key in ("proprio", "state", "goal_state", "distance_to_target"):
            rows[key].append(info[key])
    np.savez_compressed(
        f"swm_TwoRoom-v1-walls-{seed}.npz",
        action=np.array(actions),
        reward=np.array(rewards, np.float64),
        terminated=np.array(terminations),
        frame_first=first,
        frame_last=env.render(),
        variation=json.dumps(plain(env.variation_space.value)),
        obs=np.array(rows.pop("obs"), np.float64),
        **{f"info.{key}": np.array(value, np.float64) for key, value in rows.items()},
    )
