"""Steps per second of Gymnasium environments in worker processes, compared with Gymnasium's `AsyncVectorEnv`.

    python benches/bench_gym.py [--pairs 5] [--seconds 3]

Both sides step in turns, with random actions and without rendering. The output has the median, lowest and highest rates,
and the processor time per step (of all processes, as the kernel counts it).
"""

import argparse
import os
import statistics
import time
from collections.abc import Callable

import ale_py
import gymnasium

import stable_worldmodel as swm

gymnasium.register_envs(ale_py)

IDS = ["CartPole-v1", "ALE/Pong-v5"]


def processor() -> float:
    """Seconds of processor time of this process and its running children."""
    ticks, own, ticks_used = os.sysconf("SC_CLK_TCK"), str(os.getpid()), 0
    for process in filter(str.isdigit, os.listdir("/proc")):
        try:
            with open(f"/proc/{process}/stat") as file:
                words = file.read().rpartition(") ")[2].split()
        except OSError:
            continue
        if own in (process, words[1]):
            ticks_used += int(words[11]) + int(words[12])
    return ticks_used / ticks


def turn(step: Callable[[], object], envs: int, seconds: float) -> tuple[float, float]:
    """Steps per second, and microseconds of processor time per step."""
    steps, used, begun = 0, processor(), time.perf_counter()
    while time.perf_counter() - begun < seconds:
        for _ in range(10):
            step()
        steps += 10 * envs
    return steps / (time.perf_counter() - begun), (processor() - used) / steps * 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ids", nargs="+", default=IDS)
    parser.add_argument("--envs", nargs="+", type=int, default=[2, 4, 8])
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=3.0)
    given = parser.parse_args()
    for name in given.ids:
        for n in given.envs:
            world = swm.World(name, num_envs=n, add_pixels=False, workers=True)
            world.set_policy(swm.policy.RandomPolicy(seed=0))
            world.reset(seed=0)
            envs = gymnasium.make_vec(name, num_envs=n, vectorization_mode="async", vector_kwargs={"shared_memory": True})
            envs.reset(seed=0)
            sides = {"World": world.step, "AsyncVectorEnv": lambda envs=envs: envs.step(envs.action_space.sample())}
            turns: dict[str, list[tuple[float, float]]] = {side: [] for side in sides}
            for _ in range(given.pairs):
                for side, step in sides.items():
                    turns[side].append(turn(step, n, given.seconds))
            for side, found in turns.items():
                rates, costs = zip(*found, strict=True)
                print(
                    f"{name}, {n} environments, {side}: {statistics.median(rates):,.0f} steps/s"
                    f" ({min(rates):,.0f} to {max(rates):,.0f}), {statistics.median(costs):,.0f} us of processor time a step"
                )
            ratio = statistics.median(a / b for (a, _), (b, _) in zip(*turns.values(), strict=True))
            print(f"{name}, {n} environments: {ratio:.2f} x")
            envs.close()
            world.close()


if __name__ == "__main__":
    main()
