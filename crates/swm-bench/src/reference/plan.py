"""Measures the reference's CEM with a model whose costs are known beforehand, on request: `solve SECONDS`, line by line.

Answers are lines that begin with `SWM `; whatever else the reference prints is not ours.
"""

import sys
import time
from importlib.metadata import version

import gymnasium as gym
import numpy as np
import torch
from stable_worldmodel.policy import PlanConfig
from stable_worldmodel.solver import CEMSolver

envs, samples, iterations, elites, horizon, dim = map(int, sys.argv[1:7])


class Free:
    """Costs are drawn once; asking for them takes no time."""

    def __init__(self):
        generator = torch.Generator().manual_seed(0)
        self.costs = [torch.rand(envs, samples, generator=generator) for _ in range(iterations)]
        self.asked = 0

    def get_cost(self, infos, candidates):
        self.asked += 1
        return self.costs[self.asked % iterations]


model = Free()
# All environments in one batch, which is the reference's fastest way.
solver = CEMSolver(model, batch_size=envs, num_samples=samples, n_steps=iterations, topk=elites)
actions = gym.spaces.Box(-1.0, 1.0, shape=(envs, dim), dtype=np.float32)
solver.configure(action_space=actions, n_envs=envs, config=PlanConfig(horizon=horizon, receding_horizon=horizon))
infos = {"state": torch.zeros(envs, 1)}


def solve(seconds):
    model.asked = 0
    begun = time.perf_counter()
    while (elapsed := time.perf_counter() - begun) < seconds:
        solver.solve(infos)
    return model.asked, elapsed


def answer(*words):
    print("SWM", *words, flush=True)


answer("ready", version("stable-worldmodel"))
for line in sys.stdin:
    _, seconds = line.rstrip("\n").split("\t")
    answer(*solve(float(seconds)))
