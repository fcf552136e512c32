"""Measures stepping and collecting of the reference implementation.

Requests, one per line: `step SECONDS`, `bare SECONDS` (environments without frames and without a `World`) or
`collect PATH EPISODES SEED`. Answers are lines that start with `SWM `; other output of the reference is ignored.
"""

import sys
import time
from importlib.metadata import version

import gymnasium
import lance
import numpy as np
import stable_worldmodel as swm
from stable_worldmodel.policy import RandomPolicy

env, envs, height, width, limit = sys.argv[1], *map(int, sys.argv[2:6])
world = swm.World(env, num_envs=envs, image_shape=(height, width), max_episode_steps=limit)
world.set_policy(RandomPolicy(seed=0))
world.reset(seed=0)


def step(seconds):
    steps = 0
    begun = time.perf_counter()
    while (elapsed := time.perf_counter() - begun) < seconds:
        _, _, terminated, truncated, world.infos = world.envs.step(world.policy.get_action(world.infos))
        steps += envs
        done = np.logical_or(terminated, truncated)
        if done.any():
            _, world.infos = world.envs.reset(seed=[None] * envs, mask=done)
    return steps, elapsed


def bare(seconds):
    single_envs = [gymnasium.make(env, max_episode_steps=limit) for _ in range(envs)]
    for seed, single in enumerate(single_envs):
        single.reset(seed=seed)
        single.action_space.seed(seed)
    steps = 0
    begun = time.perf_counter()
    while (elapsed := time.perf_counter() - begun) < seconds:
        for single in single_envs:
            _, _, terminated, truncated, _ = single.step(single.action_space.sample())
            if terminated or truncated:
                single.reset()
        steps += envs
    return steps, elapsed


def collect(path, episodes, seed):
    begun = time.perf_counter()
    world.collect(path, episodes=int(episodes), seed=int(seed), progress=False)
    elapsed = time.perf_counter() - begun
    world.reset(seed=0)
    return lance.dataset(path).count_rows(), elapsed


def answer(*words):
    print("SWM", *words, flush=True)


answer("ready", version("stable-worldmodel"))
for line in sys.stdin:
    command, *arguments = line.rstrip("\n").split("\t")
    if command == "collect":
        answer(*collect(*arguments))
    else:
        answer(*(step if command == "step" else bare)(float(arguments[0])))
