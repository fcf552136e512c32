"""Steps per second of a `World` in Python, compared with the engine's command line (`swm bench envs`).

    python benches/bench_pool.py [--swm PATH] [--pairs 3]

Both sides step with random actions, in turns; the ratio is the median over the pairs of turns. The cost of a call is what
`world.step(1)` takes more than one of the steps of `world.step(100)`, which the engine takes without Python.
"""

import argparse
import json
import statistics
import subprocess
import time

import stable_worldmodel as swm

#: Steps of an episode, equal on both sides because resets cost time.
EPISODE = 500

CASES = [("swm/PushT-v1", 8, 224), ("swm/PushT-v1", 8, 64), ("swm/TwoRoom-v1", 8, 64), ("swm/PushT-v1", 8, None)]


def python(env: str, envs: int, side: int | None, seconds: float, chunk: int) -> float:
    shape = None if side is None else (side, side)
    world = swm.World(env, num_envs=envs, image_shape=shape, add_pixels=side is not None, max_episode_steps=EPISODE)
    world.set_policy(swm.policy.RandomPolicy())
    world.reset(seed=0)
    world.step(50)
    begun, steps = time.perf_counter(), 0
    while time.perf_counter() - begun < seconds:
        world.step(chunk)
        steps += chunk * envs
    return steps / (time.perf_counter() - begun)


def call_cost(env: str, envs: int, side: int | None, turns: int = 150, steps: int = 100) -> tuple[float, float]:
    """The median seconds of a call of `World.step` over the engine's step, and of that step."""
    shape = None if side is None else (side, side)
    world = swm.World(env, num_envs=envs, image_shape=shape, add_pixels=side is not None, max_episode_steps=EPISODE)
    world.set_policy(swm.policy.RandomPolicy())
    world.reset(seed=0)
    world.step(200)
    costs, engine = [], []
    for _ in range(turns):
        begun = time.perf_counter()
        for _ in range(steps):
            world.step(1)
        between = time.perf_counter()
        world.step(steps)
        engine.append((time.perf_counter() - between) / steps)
        costs.append((between - begun) / steps - engine[-1])
    return statistics.median(costs), statistics.median(engine)


def command(program: str, env: str, envs: int, side: int | None) -> float:
    words = [program, "--json", "bench", "envs", env, "--num-envs", str(envs), "--pairs", "1", "--episodes", "0"]
    words += ["--episode-steps", str(EPISODE), "--sizes", str(side or 64)]
    report = json.loads(subprocess.run(words, check=True, capture_output=True, text=True).stdout)
    what = "step" if side is None else "step + render"
    return next(row["steps_per_second"] for row in report["rows"] if row["what"] == what)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--swm", default="swm")
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--chunk", type=int, default=1, help="steps in one call")
    given = parser.parse_args()
    for env, envs, side in [("swm/TwoRoom-v1", 8, None), *CASES]:
        cost, engine = call_cost(env, envs, side)
        size = f"{side} px" if side else "no frames"
        print(f"{env}, {envs} environments, {size}: a call costs {1e6 * cost:.1f} us over the engine's {1e6 * engine:.1f} us")
    for env, envs, side in CASES:
        rates, command_rates = [], []
        for _ in range(given.pairs):
            rates.append(python(env, envs, side, given.seconds, given.chunk))
            command_rates.append(command(given.swm, env, envs, side))
        ratio = statistics.median(a / b for a, b in zip(rates, command_rates, strict=True))
        size = f"{side} px" if side else "no frames"
        print(f"{env}, {envs} environments, {size}: {statistics.median(rates):,.0f} steps/s, {ratio:.2f} x the command line")


if __name__ == "__main__":
    main()
