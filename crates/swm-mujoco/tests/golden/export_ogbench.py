"""Records rollouts of the reference's OGBench environments for `tests/it/golden.rs`.

    python export_ogbench.py OUT [--envs cube scene maze] [--seeds 1 2] [--steps 40] [--no-frames]

Needs `stable-worldmodel` 0.1.1 with `mujoco` 3.17.0, `dm_control` 1.0.50 and `ogbench` 1.2.2. The layout is that of
`swm_conformance::golden`; options are part of the name (`swm_OGBCube-v0,env_type=double-all-1.npz`), and files of mazes contain the goal
(`goal.xy`). Odd seeds draw a new random action in every step, even seeds in every eighth step.
"""

import argparse
import json
import os

os.environ.setdefault("MUJOCO_GL", "egl")

import gymnasium as gym
import numpy as np
import stable_worldmodel  # noqa: F401  registers the environments

CUBES = [dict(env_type=kind) for kind in ("single", "double", "triple", "quadruple", "octuple")]
MAZES = [
    dict(loco_env_type=agent, maze_type=maze)
    for agent in ("point", "ant")
    for maze in ("arena", "medium", "large", "giant", "teleport")
]
ENVS = {"cube": ("swm/OGBCube-v0", CUBES), "scene": ("swm/OGBScene-v0", [{}]), "maze": ("swm/OGBMaze-v0", MAZES)}


def values(space):
    if hasattr(space, "spaces"):
        return {key: values(inner) for key, inner in space.spaces.items()}
    return np.asarray(space.value).tolist()


def factors(env):
    while not hasattr(env, "variation_space"):
        env = env.env
    return json.dumps(values(env.variation_space))


def start(model, data):
    parts = {name: getattr(data, name) for name in ("qpos", "qvel", "ctrl", "qacc_warmstart")}
    parts["time"] = [data.time]
    if model.nmocap:
        parts |= {"mocap_pos": data.mocap_pos, "mocap_quat": data.mocap_quat}
    if model.neq:
        parts["eq_active"] = data.eq_active
    return {f"start.{name}": np.array(part, np.float64) for name, part in parts.items()}


def record(env_id, options, varied, seed, steps, frames):
    np.random.seed(seed)
    env = gym.make(env_id, disable_env_checker=True, **options)
    observation, info = env.reset(seed=seed, options={"variation": ["all"]} if varied else {})
    inner = env.unwrapped
    model, data = inner.model, inner.data
    arrays = start(model, data) | {"variation": np.array(factors(env))}
    if "Maze" in env_id:
        arrays["goal.xy"] = np.array(inner.cur_goal_xy, np.float64)
    if frames:
        arrays["frame_first"] = env.render()
    rng = np.random.default_rng(seed)
    rows = dict(obs=[np.array(observation)], qpos_qvel=[np.concatenate([data.qpos, data.qvel])])
    infos, log = [info], dict(action=[], reward=[], terminated=[])
    for step in range(steps):
        if seed % 2 or step % 8 == 0:
            action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        observation, reward, terminated, _, info = env.step(action)
        rows["obs"].append(np.array(observation))
        rows["qpos_qvel"].append(np.concatenate([data.qpos, data.qvel]))
        infos.append(info)
        for name, value in zip(log, (action, reward, terminated)):
            log[name].append(value)
    arrays |= {name: np.array(value) for name, value in (rows | log).items()}
    for name in set(infos[0]) | set(infos[1]) - {"env_name"}:
        if name != "env_name":
            arrays[f"info.{name}"] = np.array([info[name] for info in infos if name in info], np.float64)
    if frames:
        arrays["frame_last"] = env.render()
    env.close()
    return arrays


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("out")
    parser.add_argument("--envs", nargs="+", default=list(ENVS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--no-frames", action="store_true")
    args = parser.parse_args()
    os.makedirs(args.out, exist_ok=True)
    for env_id, options in ((ENVS[name][0], options) for name in args.envs for options in ENVS[name][1]):
        for varied in (False, True):
            for seed in args.seeds:
                name = "".join([env_id.replace("/", "_")] + [f",{key}={value}" for key, value in options.items()])
                file = f"{name}-{'all' if varied else 'default'}-{seed}.npz"
                arrays = record(env_id, options, varied, seed, args.steps, not args.no_frames)
                np.savez_compressed(os.path.join(args.out, file), **arrays)
                print(file)


if __name__ == "__main__":
    main()
