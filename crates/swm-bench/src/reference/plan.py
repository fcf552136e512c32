"""Measures the CEM of the reference implementation with a model of precomputed costs.

Requests, one per line: `solve SECONDS`. Answers are lines that start with `SWM `; other output of the reference is
ignored.
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


class PrecomputedCosts:
    """A model with random costs that are drawn once."""

    def __init__(self):
        generator = torch.Generator().manual_seed(0)
        self.costs = [torch.rand(envs, samples, generator=generator) for _ in range(iterations)]
        self.calls = 0

    def get_cost(self, infos, candidates):
        self.calls += 1
        return self.costs[self.calls % iterations]


model = PrecomputedCosts()
# One batch of all environments is the fastest setting of the reference.
solver = CEMSolver(model, batch_size=envs, num_samples=samples, n_steps=iterations, topk=elites)
actions = gym.spaces.Box(-1.0, 1.0, shape=(envs, dim), dtype=np.float32)
solver.configure(action_space=actions, n_envs=envs, config=PlanConfig(horizon=horizon, receding_horizon=horizon))
infos = {"state": torch.zeros(envs, 1)}


def solve(seconds):
    model.calls = 0
    begun = time.perf_counter()
    while (elapsed := time.perf_counter() - begun) < seconds:
        solver.solve(infos)
    return model.calls, elapsed


def answer(*words):
    print("SWM", *words, flush=True)


answer("ready", version("stable-worldmodel"))
for line in sys.stdin:
    _, seconds = line.rstrip("\n").split("\t")
    answer(*solve(float(seconds)))
