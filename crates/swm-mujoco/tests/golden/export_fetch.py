"""Records rollouts of the reference's Fetch environments in the layout of `swm_conformance::golden`.

    python export_fetch.py FOLDER [SEED ...] [--steps N] [--factors KEY,KEY] [--no-frames]

Needs stable-worldmodel, gymnasium-robotics 1.4.2 and mujoco 3.3.2. `--factors` lists the factors to vary; `each` stands
for the names of all factors. For `all`, the reference samples every factor but applies only `block.mass`.
"""

import argparse
import json
import os

os.environ.setdefault("MUJOCO_GL", "egl")
import gymnasium as gym
import numpy as np
import stable_worldmodel  # noqa: F401

TASKS = ["FetchReach-v3", "FetchPush-v3", "FetchSlide-v3", "FetchPickAndPlace-v3"]


def factors(space):
    """Returns the values of all factors, nested like the space."""
    if hasattr(space, "spaces"):
        return {key: factors(subspace) for key, subspace in space.spaces.items()}
    return np.asarray(space.value).tolist()


def leaves(space, prefix=""):
    for key, subspace in space.spaces.items():
        name = f"{prefix}{key}"
        yield from leaves(subspace, name + ".") if hasattr(subspace, "spaces") else [name]


def record(task, seed, steps, requested, frames):
    env = gym.make(f"swm/{task}", render_mode="rgb_array" if frames else None)
    data = env.unwrapped.data
    space = env.get_wrapper_attr("variation_space")
    options = None if requested is None else {"variation": list(leaves(space)) if requested == ["each"] else requested}
    obs, info = env.reset(seed=seed, options=options)
    start = {key: np.array(getattr(data, key), dtype=np.float64) for key in
             ["qpos", "qvel", "mocap_pos", "mocap_quat", "qacc_warmstart", "eq_active"]}
    if len(data.ctrl):
        start["ctrl"] = np.array(data.ctrl)
    start["time"] = np.array([data.time])
    pose = lambda: np.concatenate([data.qpos, data.qvel])
    rows = {"obs": [obs], "qpos_qvel": [pose()], "action": [], "reward": [], "terminated": []}
    infos = {key: [np.array(info[key])] for key in ["proprio", "state", "goal_state"]}
    images = {"frame_first": env.render()} if frames else {}
    draw = np.random.default_rng(seed)
    for _ in range(steps):
        action = draw.uniform(-1, 1, 4).astype(np.float32)
        obs, reward, terminated, _, info = env.step(action)
        for key, value in [("action", action), ("reward", reward), ("terminated", terminated), ("obs", obs),
                           ("qpos_qvel", pose())]:
            rows[key].append(value)
        for key, values in infos.items():
            values.append(np.array(info[key]))
    if frames:
        images["frame_last"] = env.render()
    return {
        **{key: np.array(values) for key, values in rows.items()},
        **{f"info.{key}": np.array(values) for key, values in infos.items()},
        **{f"start.{key}": value for key, value in start.items()},
        **images,
        "variation": np.array(json.dumps(factors(space))),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder")
    parser.add_argument("seeds", nargs="*", type=int, default=[0])
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--factors")
    parser.add_argument("--no-frames", action="store_true")
    args = parser.parse_args()
    requested = args.factors.split(",") if args.factors else None
    for task in TASKS:
        for seed in args.seeds:
            kind = "default" if requested is None else "all" if requested == ["all"] else "each"
            arrays = record(task, seed, args.steps, requested, not args.no_frames)
            np.savez_compressed(os.path.join(args.folder, f"swm_{task}-{kind}-{seed}.npz"), **arrays)


if __name__ == "__main__":
    main()
