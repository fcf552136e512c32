"""Records rollouts of the reference's DeepMind Control environments for `src/dmc/golden.rs`.

    python export_dmc.py OUT [--seeds 1 2 3] [--steps 40] [--tasks hop walk …] [--domains Hopper …] [--no-frames]

Needs `stable-worldmodel` 0.1.1 with `mujoco` 3.17.0 and `dm_control` 1.0.50. The layout is that of `swm_conformance::golden`;
each file also contains the name of the task (`task`) and the position of its target (`start.target`).

The reference has some tasks of the suite and tasks of its own. This script adds the remaining tasks of the suite to the reference's
environments, with the factors and the action repeat of these environments.
"""

import argparse
import json
import os
from types import SimpleNamespace

os.environ.setdefault("MUJOCO_GL", "egl")

import gymnasium as gym
import numpy as np
import stable_worldmodel  # noqa: F401  registers the environments
from dm_control import mjcf
from dm_control.suite import acrobot, cartpole, humanoid, manipulator, quadruped

TASKS = {
    "Acrobot": ["swingup_sparse", "swingup"],
    "BallInCup": ["catch"],
    "Cartpole": ["swingup_sparse", "swingup", "balance", "balance_sparse"],
    "Cheetah": ["run", "run-backward", "stand-front", "stand-back", "jump", "run-front", "run-back", "lie-down",
                "legs-up", "flip", "flip-backward"],
    "Finger": ["turn_hard", "turn_easy", "spin"],
    "Hopper": ["hop", "stand", "hop-backward", "flip", "flip-backward"],
    "Humanoid": ["walk", "stand", "run", "run_pure_state"],
    "Manipulator": ["bring_ball", "bring_peg", "insert_ball", "insert_peg"],
    "Pendulum": ["swingup"],
    "Quadruped": ["walk", "run", "fetch"],
    "Reacher": ["hard", "easy", "qpos_match"],
    "Walker": ["walk", "stand", "run", "walk-backward", "arabesque", "lie_down", "legs_up", "flip"],
}
# Tasks of the suite that the reference's environments lack.
ADDED = {
    ("Acrobot", "swingup"): lambda: acrobot.Balance(sparse=False),
    ("Cartpole", "swingup"): lambda: cartpole.Balance(swing_up=True, sparse=False),
    ("Cartpole", "balance"): lambda: cartpole.Balance(swing_up=False, sparse=False),
    ("Cartpole", "balance_sparse"): lambda: cartpole.Balance(swing_up=False, sparse=True),
    ("Humanoid", "run_pure_state"): lambda: humanoid.Humanoid(move_speed=10, pure_state=True),
    ("Manipulator", "bring_peg"): lambda: manipulator.Bring(use_peg=True, insert=False, fully_observable=True),
    ("Manipulator", "insert_ball"): lambda: manipulator.Bring(use_peg=False, insert=True, fully_observable=True),
    ("Manipulator", "insert_peg"): lambda: manipulator.Bring(use_peg=True, insert=True, fully_observable=True),
    ("Quadruped", "fetch"): lambda: quadruped.Fetch(),
}
# Environments of the reference without a `task` argument: their task is the first in `TASKS`.
SINGLE_TASK = ["Acrobot", "BallInCup", "Cartpole", "Manipulator", "Pendulum"]
START = ("qpos", "qvel", "act", "ctrl", "qacc_warmstart", "eq_active", "time")


def to_lists(value):
    if isinstance(value, dict):
        return {key: to_lists(inner) for key, inner in value.items()}
    return np.asarray(value).tolist()


def own_model(domain, task):
    """The model of a task that cannot use the reference's model."""
    if domain == "Manipulator":
        xml, assets = manipulator.make_model(use_peg="peg" in task, insert="insert" in task)
    else:
        xml, assets = quadruped.make_model(walls_and_ball=True), quadruped.common.ASSETS
    folder = os.path.dirname(manipulator.__file__)
    return mjcf.from_xml_string(xml.replace(b'file="./common/', b'file="common/'), model_dir=folder, assets=assets)


def make(domain, task):
    name = f"swm/{domain}DMControl-v0"
    if (domain, task) not in ADDED:
        return gym.make(name, **({} if domain in SINGLE_TASK else {"task": task})).unwrapped
    env = gym.make(name).unwrapped
    inner = env.compile_model

    def compile_model(seed=None, environment_kwargs=None):
        inner(seed=seed, environment_kwargs=environment_kwargs)
        env.env._env._task = ADDED[domain, task]()

    if task in ("bring_peg", "insert_ball", "insert_peg", "fetch"):
        env._mjcf_model = own_model(domain, task)
        if "peg" in task:
            # The reference edits the ball's target, which this model lacks, so a dummy object receives the edit.
            edit = env.modify_mjcf_model

            class WithBall:
                def __init__(self, model):
                    self.model, self.ball = model, SimpleNamespace(type="sphere", size=None)

                def find(self, kind, name):
                    return self.ball if name == "target_ball" else self.model.find(kind, name)

            def modify(model):
                edit(WithBall(model))
                return model

            env.modify_mjcf_model = modify
    env.compile_model = compile_model
    env.compile_model()
    return env


def record(domain, task, varied, seed, steps, frames):
    env = make(domain, task)
    obs, info = env.reset(seed=seed, options={"variation": ["all"]} if varied else None)
    physics = env.env.physics
    out = {f"start.{name}": np.atleast_1d(np.array(getattr(physics.data, name), dtype=np.float64)) for name in START}
    out = {name: value for name, value in out.items() if value.size}
    model = physics.named.model
    if domain == "Reacher":
        out["start.target"] = np.array(model.geom_pos["target"])
    elif domain == "Finger":
        out["start.target"] = np.array(model.site_pos["target"])
    elif domain == "Manipulator":
        target = "target_peg" if "peg" in task else "target_ball"
        out["start.target"] = np.r_[model.body_pos[target], model.body_quat[target]]
    rng = np.random.default_rng([seed, len(domain), varied])
    rows = {"obs": [obs], "qpos_qvel": [np.r_[info["qpos"], info["qvel"]]]}
    infos = {key: [value] for key, value in info.items() if key != "env_name"}
    if frames:
        out["frame_first"] = env.render()
    actions, rewards, ends = [], [], []
    for _ in range(steps):
        action = rng.uniform(-1.0, 1.0, env.action_space.shape)
        obs, reward, terminated, _, info = env.step(action)
        actions.append(action)
        rewards.append(reward)
        ends.append(terminated)
        rows["obs"].append(obs)
        rows["qpos_qvel"].append(np.r_[info["qpos"], info["qvel"]])
        for key, values in infos.items():
            values.append(info[key])
    if frames:
        out["frame_last"] = env.render()
    out |= {key: np.array(value, dtype=np.float64) for key, value in rows.items()}
    out |= {f"info.{key}": np.array(value, dtype=np.float64) for key, value in infos.items()}
    out |= {"action": np.array(actions), "reward": np.array(rewards, dtype=np.float64), "terminated": np.array(ends)}
    out["variation"] = np.array(json.dumps(to_lists(env.variation_space.value)))
    out["task"] = np.array(task)
    env.close()
    return out


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("out")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--no-frames", action="store_true")
    parser.add_argument("--domains", nargs="+", default=list(TASKS))
    parser.add_argument("--tasks", nargs="+")
    args = parser.parse_args()
    os.makedirs(args.out, exist_ok=True)
    for domain in args.domains:
        for task in TASKS[domain]:
            if args.tasks and task not in args.tasks:
                continue
            for seed in args.seeds:
                for varied in (False, True):
                    name = f"swm_{domain}DMControl-v0-{'all' if varied else 'default'}-{task}-{seed}.npz"
                    data = record(domain, task, varied, seed, args.steps, not args.no_frames)
                    np.savez_compressed(os.path.join(args.out, name), **data)
                    print(name, "reward", float(data["reward"].sum()), flush=True)


if __name__ == "__main__":
    main()
