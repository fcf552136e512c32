"""What a torch cost model costs an iteration of CEM: our solver in Python, beside the engine's own and the reference's.

    python benches/bench_planning.py [--swm PATH] [--pairs 5]

The costs are drawn once, so that an iteration is the solver, and for a torch model the way of the candidates to Python and
of the costs back. The engine's iterations, and those of the reference where `$SWM_REFERENCE_PYTHON` names a Python that has
it, are measured by `swm bench plan` in turns with ours; the results are medians over the turns.
"""

import argparse
import json
import statistics
import subprocess
import time

import gymnasium
import numpy as np
import torch

import stable_worldmodel as swm


class PrecomputedCosts:
    """A cost model with random costs that are drawn once."""

    def __init__(self, envs: int, samples: int, iterations: int) -> None:
        generator = torch.Generator().manual_seed(0)
        self.costs = [torch.rand(envs, samples, generator=generator) for _ in range(iterations)]
        self.calls = 0

    def get_cost(self, infos: dict, candidates: torch.Tensor) -> torch.Tensor:
        self.calls += 1
        return self.costs[self.calls % len(self.costs)]


def torch_iteration(settings: dict, envs: int, seconds: float) -> float:
    """The seconds of an iteration with a torch model."""
    samples, iterations, horizon, dim = (settings[key] for key in ("samples", "iterations", "horizon", "dim"))
    model = PrecomputedCosts(envs, samples, iterations)
    solver = swm.solver.CEMSolver(model, batch_size=envs, num_samples=samples, n_steps=iterations, topk=samples // 10)
    space = gymnasium.spaces.Box(-1.0, 1.0, shape=(envs, dim), dtype=np.float32)
    config = swm.PlanConfig(horizon=horizon, receding_horizon=horizon)
    solver.configure(action_space=space, n_envs=envs, config=config)
    infos = {"state": torch.zeros(envs, 1)}
    solver.solve(infos)
    model.calls, begun = 0, time.perf_counter()
    while time.perf_counter() - begun < seconds:
        solver.solve(infos)
    return (time.perf_counter() - begun) / model.calls


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--swm", default="swm")
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=1.0)
    given = parser.parse_args()
    words = [given.swm, "--json", "bench", "plan", "--iterations", "0", "--pairs", "1", "--seconds", str(given.seconds)]
    turns: dict[int, list[tuple[float, float, float | None]]] = {}
    for _ in range(given.pairs):
        report = json.loads(subprocess.run(words, check=True, capture_output=True, text=True).stdout)["planner"]
        for row in report["rows"]:
            ours = torch_iteration(report, row["envs"], given.seconds)
            reference = 1 / row["reference"][0] if row["reference"] else None
            turns.setdefault(row["envs"], []).append((ours, 1 / row["ours"][0], reference))
    for envs, rows in turns.items():
        over = statistics.median(ours - engine for ours, engine, _ in rows)
        engine = statistics.median(engine for _, engine, _ in rows)
        text = (
            f"{envs} environments: a torch cost model adds {1e6 * over:.0f} us an iteration to the engine's {1e6 * engine:.0f}"
        )
        ratios = [reference / ours for ours, _, reference in rows if reference is not None]
        print(text + (f"; the reference takes {statistics.median(ratios):.1f} x as long with one" if ratios else ""))


if __name__ == "__main__":
    main()
