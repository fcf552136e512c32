"""Writes gradient_solvers.json: iterates and plans of torch's optimizers and of the reference's gradient solvers.

    python export_gradient_solvers.py      # with the package stable-worldmodel 0.1.1 and torch installed

The same problems are defined in ../it/gradient.rs. No value is random.
"""

import json
from pathlib import Path
from types import SimpleNamespace

import torch
from gymnasium.spaces import Box, Discrete
from stable_worldmodel.solver import GradientSolver, LagrangianSolver, PGDSolver

HORIZON, DIM = 3, 2
SCALE = torch.tensor([[1.0, 0.4], [0.2, 0.7], [0.5, 0.1]])
TARGET = torch.tensor([[1.0, -2.0], [0.5, 3.0], [-1.5, 0.25]])


class Bowl(torch.nn.Module):
    """Half the scaled squared distance to a target; the sum of the values of a step is at most a half."""

    def get_cost(self, info, actions):
        return (0.5 * SCALE * (actions - TARGET) ** 2).sum(dim=(-1, -2))

    def get_constraints(self, info, actions):
        return actions.sum(dim=-1) - 0.5


class Choice(torch.nn.Module):
    """A scaled squared distance for two steps with one choice among three options each."""

    scale = torch.tensor([[0.6, 0.2, 0.3], [0.1, 0.5, 0.4]])
    target = torch.tensor([[0.9, 0.4, -0.2], [0.2, 0.3, 1.1]])

    def get_cost(self, info, actions):
        return (0.5 * self.scale * (actions - self.target) ** 2).sum(dim=(-1, -2))


class Unconstrained(torch.nn.Module):
    def get_cost(self, info, actions):
        return Bowl.get_cost(self, info, actions)


def optimizers():
    scale = torch.tensor([1.0, 4.0, 0.3, 0.05])
    table = {
        "sgd": (torch.optim.SGD, {"lr": 0.1, "momentum": 0.9}),
        "adam": (torch.optim.Adam, {"lr": 0.1}),
        "rmsprop": (torch.optim.RMSprop, {"lr": 0.01}),
    }
    found = {}
    for name, (kind, settings) in table.items():
        x = torch.tensor([1.0, -2.0, 0.5, 3.0], requires_grad=True)
        optimizer, path = kind([x], **settings), []
        for _ in range(5):
            optimizer.zero_grad()
            (0.5 * scale * x * x).sum().backward()
            optimizer.step()
            path.append(x.tolist())
        found[name] = path
    return found


def solve(solver, space, horizon, start=None):
    solver.configure(action_space=space, n_envs=1, config=SimpleNamespace(horizon=horizon, action_block=1))
    return solver, solver.solve({"state": torch.zeros(1, 1)}, init_action=start)


def main():
    box = Box(-10, 10, shape=(1, DIM))
    sgd = {"optimizer_cls": torch.optim.SGD, "optimizer_kwargs": {"lr": 0.5, "momentum": 0.9}}
    _, descent = solve(GradientSolver(Unconstrained(), n_steps=4, grad_clip=1.0, **sgd), box, HORIZON)
    first = torch.tensor([[[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]])
    pgd, projected = solve(PGDSolver(Choice(), n_steps=4), Discrete(3), 2, first)
    settings = {"n_steps": 3, "n_outer_steps": 3, "rho_init": 1.0, "rho_max": 3.0, "rho_scale": 2.0}
    adam = {"optimizer_cls": torch.optim.Adam, "optimizer_kwargs": {"lr": 0.1}}
    _, augmented = solve(LagrangianSolver(Bowl(), **settings, **adam), box, HORIZON)
    found = {
        "optimizers": optimizers(),
        "gd": {"actions": descent["actions"].flatten().tolist(), "costs": descent["cost"][0]},
        "pgd": {
            "relaxed": pgd.init.flatten().tolist(),
            "choices": projected["actions"].flatten().tolist(),
            "costs": projected["cost"][0],
        },
        "lagrangian": {
            "actions": augmented["actions"].flatten().tolist(),
            "multipliers": augmented["lambdas"].flatten().tolist(),
            "losses": augmented["cost"][0],
        },
    }
    Path(__file__).with_name("gradient_solvers.json").write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
