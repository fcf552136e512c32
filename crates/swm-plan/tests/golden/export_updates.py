"""Writes updates.json: every iteration of the reference's sampling solvers, with the noise of that iteration.

Run with the Python package `stable-worldmodel` 0.1.1 (and torch) installed:

    python export_updates.py > updates.json

The script records every random draw, every population with its costs, and the distribution after each update. It does
not change the solvers. The minimum of the toy cost is within the bounds in some dimensions and outside in others.
"""

import contextlib
import io
import json
from types import SimpleNamespace

import gymnasium as gym
import torch
from stable_worldmodel.solver import CEMSolver, ICEMSolver, MPPISolver
from stable_worldmodel.solver.categorical_cem import CategoricalCEMSolver

HORIZON, DIM, SAMPLES, ITERATIONS, ELITES, BOUND = 4, 2, 16, 3, 5, 1.0
OPTIONS, BLOCK = 3, 2


class Toy:
    """A quadratic cost that records every population and its costs."""

    def __init__(self, size):
        self.target = torch.linspace(-1.5, 1.2, size)
        self.weight = torch.linspace(1.0, 2.0, size)
        self.recorded = []

    def get_cost(self, _, candidates):
        plans = candidates[0].reshape(candidates.shape[1], -1)
        costs = (self.weight * (plans - self.target) ** 2).sum(-1)
        self.recorded.append((plans.clone(), costs.clone()))
        return costs[None]


class Record:
    """The distribution after every update."""

    output_key = "record"

    def __init__(self):
        self.history = []

    def __call__(self, **state):
        names = [name for name in ("mean", "var", "probs") if name in state]
        self.history.append({name: state[name][0].clone() for name in names})

    def reset(self): ...
    def start_batch(self): ...
    def end_solve(self): ...


def run(make, space, size, block):
    toy, record, noise = Toy(size), Record(), []
    randn = torch.randn

    def recorded(*shape, **options):
        noise.append(randn(*shape, **options))
        return noise[-1]

    solver = make(toy, record)
    solver.configure(
        action_space=space, n_envs=1, config=SimpleNamespace(horizon=HORIZON, action_block=block, receding_horizon=1)
    )
    torch.randn = recorded
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            plan = solver.solve({"x": torch.zeros(1, 1)})["actions"][0]
    finally:
        torch.randn = randn
    return toy.recorded, record.history, noise, plan


def flat(tensor):
    return [float(f"{value:.8g}") for value in tensor.flatten().tolist()]


def main():
    box = gym.spaces.Box(-BOUND, BOUND, (1, DIM))
    discrete = gym.spaces.Discrete(OPTIONS)
    common = {"num_samples": SAMPLES, "n_steps": ITERATIONS, "topk": ELITES, "seed": 7}
    solvers = {
        "cem": (lambda toy, record: CEMSolver(toy, callbacks=[record], **common), box, HORIZON * DIM, 1),
        "icem": (
            lambda toy, record: ICEMSolver(toy, callbacks=[record], n_elite_keep=2, alpha=0.25, **common),
            box, HORIZON * DIM, 1,
        ),
        "mppi": (lambda toy, _: MPPISolver(toy, temperature=0.5, **common), box, HORIZON * DIM, 1),
        "categorical_cem": (
            lambda toy, record: CategoricalCEMSolver(toy, callbacks=[record], smoothing=0.05, alpha=0.25, **common),
            discrete, HORIZON * BLOCK * OPTIONS, BLOCK,
        ),
    }
    out = {}
    for name, arguments in solvers.items():
        torch.manual_seed(0)
        recorded, states, noise, plan = run(*arguments)
        if name == "mppi":
            # MPPI has no callbacks. Its mean is the first candidate of the next iteration; its last mean is the plan.
            states = [{"mean": plans[0]} for plans, _ in recorded[1:]] + [{"mean": plan}]
        out[name] = [
            {"candidates": flat(plans), "costs": flat(costs)}
            | {key: flat(value) for key, value in state.items()}
            # iCEM draws its noise as [envs, samples, dim, horizon].
            | ({"noise": flat(noise[i][0].transpose(-1, -2) if name == "icem" else noise[i][0])} if noise else {})
            for i, ((plans, costs), state) in enumerate(zip(recorded, states, strict=True))
        ]
    print(json.dumps(out))


main()
