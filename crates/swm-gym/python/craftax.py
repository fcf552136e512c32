"""Craftax as Gymnasium environments, under the ids, spaces and sizes of stable-worldmodel's Python package.

Craftax is a pure JAX function from a key, a state and an action to the next state; `Craftax` holds the key and
the state. Symbolic variants render with the renderer of the pixel observations.
"""

import importlib
import os
import pickle

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from craftax.craftax_env import make_craftax_env_from_name
from gymnasium import spaces

# Id: Craftax's own id, the shape of an observation (Craftax's `observation_space` swaps height and width), and the time
# limit in steps.
VARIANTS = {
    'swm/CraftaxPixels-v1': ('Craftax-Pixels-v1', (130, 110, 3), 100_000),
    'swm/CraftaxSymbolic-v1': ('Craftax-Symbolic-v1', (8268,), 100_000),
    'swm/CraftaxClassicPixels-v1': ('Craftax-Classic-Pixels-v1', (63, 63, 3), 10_000),
    'swm/CraftaxClassicSymbolic-v1': ('Craftax-Classic-Symbolic-v1', (1345,), 10_000),
}


def register():
    """Registers the ids with Gymnasium."""
    for id, (name, shape, steps) in VARIANTS.items():
        if id not in gymnasium.registry:
            gymnasium.register(
                id, Craftax, max_episode_steps=steps, kwargs={'name': name, 'shape': shape}, order_enforce=False
            )


def textured(make, *arguments):
    """Calls `make`, and rebuilds Craftax's texture cache if the cached file is incomplete."""
    try:
        return make(*arguments)
    except (EOFError, OSError, ValueError, pickle.UnpicklingError):
        os.environ['CRAFTAX_RELOAD_TEXTURES'] = 'true'
        return make(*arguments)
    finally:
        os.environ.pop('CRAFTAX_RELOAD_TEXTURES', None)


class Craftax(gymnasium.Env):
    """A Craftax environment."""

    metadata = {'render_modes': ['rgb_array'], 'render_fps': 30}
    swm_libraries = ('craftax', 'jax')
    # Frames are resized without interpolation.
    swm_pixel_art = True

    def __init__(self, name, shape, render_mode=None):
        self.render_mode = render_mode
        # Disables Craftax's automatic resets, because the pool resets the environment.
        env = textured(make_craftax_env_from_name, name, False)
        params = env.default_params
        self.observation_space = spaces.Box(0.0, 1.0, shape, np.float32)
        self.action_space = spaces.Discrete(env.num_actions)
        self.pixels = len(shape) == 3
        package = 'craftax.craftax_classic' if 'Classic' in name else 'craftax.craftax'
        constants = importlib.import_module(f'{package}.constants')
        renderer = importlib.import_module(f'{package}.renderer')
        self.draw = jax.jit(textured(renderer.make_craftax_pixel_renderer, constants.BLOCK_PIXEL_SIZE_AGENT))

        @jax.jit
        def begin(key):
            next_key, step_key = jax.random.split(key)
            return env.reset(step_key, params), next_key

        @jax.jit
        def go(key, state, action):
            next_key, step_key = jax.random.split(key)
            observation, state, reward, done, info = env.step(step_key, state, action, params)
            # One transfer of all values to the host is faster than a transfer of each value.
            self.names = list(info)
            values = jnp.stack([jnp.float32(value) for value in (reward, done, *info.values())])
            return observation, state, values, next_key

        self.begin, self.go = begin, go
        self.key = jax.random.PRNGKey(0)

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.key = jax.random.PRNGKey(seed)
        (observation, self.state), self.key = self.begin(self.key)
        self.observation = np.asarray(observation, np.float32)
        return self.observation, {}

    def step(self, action):
        observation, self.state, values, self.key = self.go(self.key, self.state, int(action))
        self.observation = np.asarray(observation, np.float32)
        reward, done, *info = np.asarray(values)
        return self.observation, float(reward), bool(done), False, dict(zip(self.names, info))

    def render(self):
        frame = self.observation * 255.0 if self.pixels else np.asarray(self.draw(self.state))
        return np.rint(np.clip(frame, 0.0, 255.0)).astype(np.uint8)
