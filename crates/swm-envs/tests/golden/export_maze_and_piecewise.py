"""Records rollouts of the Python reference's SimplePointMaze and Piecewise (pip install stable-worldmodel matplotlib)
that bump into walls, cross zones and end at their goals, in the layout of the other golden files.
Run in this folder: MPLBACKEND=agg python export_maze_and_piecewise.py [FOLDER]"""

import json
import sys

import numpy as np
from stable_worldmodel.envs.piecewise.piecewise_env import PiecewiseEnv
from stable_worldmodel.envs.simple_point_maze import SimplePointMazeEnv

# Environment class, name, varied factors, number of steps, and the seeds whose files are in this folder.
RECORDINGS = [
    (PiecewiseEnv, "Piecewise", None, 120, [3]),
    (PiecewiseEnv, "Piecewise", ["all"], 150, [8, 12]),
    (PiecewiseEnv, "Piecewise", ["rendering", "zones"], 100, [31]),
    (SimplePointMazeEnv, "SimplePointMaze", None, 150, [2, 4]),
    (SimplePointMazeEnv, "SimplePointMaze", ["all"], 150, [17, 39, 46, 53, 55]),
]
FOLDER = sys.argv[1] if len(sys.argv) > 1 else "."


def plain(value):
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    return np.asarray(value).tolist()


def action(env, rng, position, goal, aim):
    """Returns a noisy action towards `aim` (or `goal` without an aim), larger than the action space allows."""
    away = (goal if aim is None else aim) - position
    size = env.action_space.high[0]
    return (1.2 * size * away / max(np.abs(away).max(), size) + rng.normal(0, 0.4 * size, 2)).astype(np.float32)


for make, name, variation, steps, seeds in RECORDINGS:
    for seed in seeds:
        env = make(render_mode="rgb_array")
        rng = np.random.default_rng(seed)
        observation, info = env.reset(seed=seed, options={} if variation is None else {"variation": variation})
        record = json.dumps(plain(env.variation_space.value))
        columns = [key for key in ("proprio", "state", "goal_state", "distance_to_target") if key in info]
        rows = {key: [info[key]] for key in columns}
        observations, actions, rewards, terminations = [np.array(observation)], [], [], []
        first = env.render()
        for step in range(steps):
            goal_space = env.variation_space["goal" if name == "SimplePointMaze" else "target"]
            if step % 12 == 0:
                aim = rng.uniform(-0.1, 1.1, 2) * env.observation_space.high[0]
            if step > steps * 2 // 3:
                aim = None
            move = action(env, rng, np.array(observation)[:2], goal_space["position"].value, aim)
            observation, reward, terminated, _, info = env.step(move)
            observations.append(np.array(observation))
            actions.append(move)
            rewards.append(reward)
            terminations.append(terminated)
            for key in columns:
                rows[key].append(info[key])
        np.savez_compressed(
            f"{FOLDER}/swm_{name}-v0-walk-{seed}.npz",
            action=np.array(actions),
            reward=np.array(rewards, np.float64),
            terminated=np.array(terminations),
            frame_first=first,
            frame_last=env.render(),
            variation=record,
            obs=np.array(observations, np.float64),
            **{f"info.{key}": np.array(value, np.float64) for key, value in rows.items()},
        )
        stopped = (np.diff(observations, axis=0) == 0).all(1).sum()
        print(name, seed, "stopped", stopped, "at the goal", sum(terminations))
        env.close()
