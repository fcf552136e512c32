"""Measures training steps of online families in PyTorch: SAC of Stable-Baselines3, TD-MPC2 of the reference implementation.

Argument: the sizes as JSON. Requests, one per line: `run train COUNT`. Answers are lines that start with `SWM `; other output is ignored.
"""

import json
import sys
import time
from importlib.metadata import version
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import torch

c = json.loads(sys.argv[1])
torch.manual_seed(0)
rng = np.random.default_rng(0)
uniform = lambda *shape: rng.uniform(-1, 1, shape).astype(np.float32)


def sac():
    from stable_baselines3 import SAC
    from stable_baselines3.common.logger import Logger

    class Env(gym.Env):
        observation_space = gym.spaces.Box(-1.0, 1.0, (c["observation"],), np.float32)
        action_space = gym.spaces.Box(-1.0, 1.0, (c["action"],), np.float32)

    model = SAC(
        "MlpPolicy", Env(), learning_rate=c["lr"], buffer_size=10_000, batch_size=c["batch"], tau=c["tau"],
        gamma=c["discount"], policy_kwargs={"net_arch": [c["hidden"]] * 2}, device="cpu", seed=0,
    )  # fmt: skip
    model.set_logger(Logger(None, []))
    for _ in range(5_000):
        before, after, action = uniform(1, c["observation"]), uniform(1, c["observation"]), uniform(1, c["action"])
        model.replay_buffer.add(before, after, action, uniform(1), np.zeros(1), [{}])
    return lambda count: model.train(gradient_steps=count, batch_size=c["batch"]), "stable-baselines3"


def tdmpc2():
    from stable_worldmodel.wm.tdmpc2 import tdmpc2 as reference

    class Config(dict):
        """A dictionary with its keys as attributes, as the reference requires."""

        def __getattr__(self, name):
            value = self[name]
            return Config(value) if isinstance(value, dict) else value

    config = Config(
        action_dim=c["action"], extra_dims={"state": c["observation"]}, image_size=0,
        wm=dict(
            tau=c["tau"], encoding={"state": c["latent"]}, enc_dim=c["encoder"], mlp_dim=c["hidden"], num_bins=c["bins"],
            vmin=-10, vmax=10, num_q=c["critics"], simnorm_dim=c["simplex"], discount=c["discount"], horizon=c["horizon"],
            uncertainty_penalty=0.5, rho=0.5, entropy_coef=1e-4, consistency_coef=20.0, reward_coef=0.1, value_coef=0.1,
        ),
    )  # fmt: skip
    model = reference.TDMPC2(config).train()
    optimizer = torch.optim.Adam(model.parameters(), lr=c["lr"])
    steps = c["horizon"] + 1
    tensor = lambda *shape: torch.from_numpy(uniform(*shape))
    batch = {
        "state": tensor(c["batch"], steps, c["observation"]),
        "action": tensor(c["batch"], steps, c["action"]),
        "reward": tensor(c["batch"], steps),
    }
    context = SimpleNamespace(model=model, log_dict=lambda *_, **__: None)

    def train(count):
        for _ in range(count):
            optimizer.zero_grad(set_to_none=True)
            reference.tdmpc2_forward(context, dict(batch), "train", config)["loss"].backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), 20.0)
            optimizer.step()

    return train, "stable-worldmodel"


def answer(*words):
    print("SWM", *words, flush=True)


train, package = {"sac": sac, "tdmpc2": tdmpc2}[c["family"]]()
answer("ready", package, version(package), "torch", torch.__version__)
for line in sys.stdin:
    _, _, count = line.rstrip("\n").split("\t")
    begun = time.perf_counter()
    train(int(count))
    answer(int(count), time.perf_counter() - begun)
