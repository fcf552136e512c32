"""Records contact-rich rollouts of the Python reference's swm/PushT-Discrete-v1 (pip install stable-worldmodel), in the
layout of the other golden files. Release 0.1.1 has another shape Z, and a T of scale 30 only. The first rollout has
this T and the default factors; later rollouts vary all factors, with the shapes other than T and Z. Run in this folder:
python export_push_t_discrete.py"""

import json

import numpy as np
from stable_worldmodel.envs.pusht import PushTDiscrete

STEPS = 60
NEAR = 100
SHAPES = (0, 1, 4, 5, 6, 7)


def plain(value):
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    return np.asarray(value).tolist()


for seed in range(4):
    env = PushTDiscrete()
    rng = np.random.default_rng(seed)
    if seed == 0:
        options = {"variation_values": {"block.scale": np.array(30, np.float32)}}
    else:
        block, agent = rng.choice(SHAPES[1:]), rng.choice(SHAPES)
        options = {"variation": ["all"], "variation_values": {"block.shape": int(block), "agent.shape": int(agent)}}
    options["goal_state"] = np.concatenate([rng.uniform(100, 400, 4), rng.uniform(0, 2 * np.pi, 1), [0, 0]])
    observation, info = env.reset(seed=seed, options=options)
    rows = {"state": [observation["state"]], "n_contacts": [info["n_contacts"]]}
    actions, rewards, terminations = [], [], []
    first = env.render()
    for _ in range(STEPS):
        agent, block = info["pos_agent"], info["block_pose"][:2]
        target = np.clip(agent + 100 * rng.uniform(-1, 1, 2), block - NEAR, block + NEAR)
        action = env.quantizer.quantize(np.clip((target - agent) / 100, -1, 1))
        observation, reward, terminated, _, info = env.step(action)
        actions.append(action)
        rewards.append(reward)
        terminations.append(terminated)
        rows["state"].append(observation["state"])
        rows["n_contacts"].append(info["n_contacts"])
    print(seed, options, sum(n > 0 for n in rows["n_contacts"]), "steps with contacts")
    np.savez_compressed(
        f"swm_PushT-Discrete-v1-{'default' if seed == 0 else 'all'}-{seed}.npz",
        action=np.array(actions, np.int64),
        reward=np.array(rewards, np.float64),
        terminated=np.array(terminations),
        frame_first=first,
        frame_last=env.render(),
        variation=json.dumps(plain(env.variation_space.value)),
        goal_state=options["goal_state"],
        **{f"info.{key}": np.array(value) for key, value in rows.items()},
    )
