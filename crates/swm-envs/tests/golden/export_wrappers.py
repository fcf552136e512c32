"""Records the frames that the wrappers of the Python reference (pip install stable-worldmodel==0.1.1) compute from one
image, with their random draws. Run in this folder: python export_wrappers.py"""

import json

import gymnasium as gym
import numpy as np
from stable_worldmodel.wrapper import visual

HEIGHT, WIDTH = 48, 64


def test_image():
    """Smooth colours, flat shapes, a grey ramp and a corner of noise."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    frame = np.stack([255 * x / (WIDTH - 1), 255 * y / (HEIGHT - 1), 128 + 100 * np.sin(x / 7) * np.cos(y / 5)], -1)
    frame[8:24, 10:30] = (220, 30, 40)
    frame[20:40, 40:60] = (255, 255, 255)
    frame[30:44, 4:18] = (0, 0, 0)
    frame[30:34, 20:36] = (np.arange(16) * 17)[None, :, None]
    frame[2:10, 50:62] = np.random.default_rng(0).integers(0, 256, (8, 12, 3))
    return frame.round().astype(np.uint8)


class StaticEnv(gym.Env):
    """An environment that always renders the same frame."""

    render_mode = "rgb_array"
    observation_space = action_space = gym.spaces.Discrete(1)
    metadata = {"render_modes": ["rgb_array"]}

    def __init__(self, frame):
        self.frame = frame

    def reset(self, **_):
        return 0, {}

    def step(self, _):
        return 0, 0.0, False, False, {}

    def render(self):
        return self.frame.copy()


frame = test_image()
backgrounds = {
    "small": np.ascontiguousarray(frame[:20, :30, ::-1]),
    "large": np.kron(np.ascontiguousarray(frame[::-1]), np.ones((2, 2, 1), np.uint8))[:90],
}
out = {"frame": frame, **{f"background_{name}": media for name, media in backgrounds.items()}}
cases = []


def record(wrapper, settings, drawn=None, steps=0):
    wrapper.reset()
    wrapper.render()
    for _ in range(steps):
        wrapper.step(0)
    out[f"out_{len(cases)}"] = wrapper.render()
    cases.append(dict(settings, drawn=drawn(wrapper) if drawn else None, step=steps))


def to_list(value):
    return np.asarray(value, np.float64).tolist()


static_env = StaticEnv(frame)
record(visual.GrayscaleWrapper(static_env), {"wrapper": "grayscale"})
for kernel, sigma in [(3, 0), (5, 0), (7, 0), (9, 0), (4, 1.3), (15, 2.5), (31, 20)]:
    record(visual.BlurWrapper(static_env, kernel, sigma), {"wrapper": "blur", "kernel": kernel, "sigma": sigma})
for scale in [0.5, 0.25, 0.3, 0.73, 0.01]:
    record(visual.ResolutionWrapper(static_env, scale), {"wrapper": "resolution", "scale": scale})
for background in backgrounds:
    for color, tolerance in [([255, 255, 255], 0), ([220, 30, 40, 0, 0, 0], 60.5)]:
        record(
            visual.ChromaKeyWrapper(static_env, color, backgrounds[background], tolerance),
            {"wrapper": "chroma-key", "key_color": color, "tolerance": tolerance, "media": background},
        )
for seed, options in enumerate([{}, {"brightness": 0.8, "contrast": 0.9, "saturation": 0.9, "hue": 0.5}, {"hue": 0.3}]):
    record(
        visual.ColorJitterWrapper(static_env, seed=seed, **options),
        {"wrapper": "color-jitter"},
        lambda w: to_list([w._db, w._dc, w._ds, w._dh]),
    )
for kernel in [3, 5]:
    record(
        visual.RandomConvWrapper(static_env, kernel, seed=kernel),
        {"wrapper": "random-conv", "kernel_size": kernel},
        lambda w: to_list(w._weights.ravel()),
    )
record(
    visual.OcclusionWrapper(static_env, 3, (0.1, 0.4), (200, 10, 30), seed=1),
    {"wrapper": "occlusion", "num_patches": 3, "size": [0.1, 0.4], "color": [200, 10, 30]},
    lambda w: to_list(w._patches),
)
for steps in [0, 40]:
    moving = visual.MovingPatchWrapper(static_env, 2, (0.1, 0.3), speed=2.5, seed=2)
    moving.reset()
    moving.render()
    drawn = to_list(moving._patches)
    moving.reset = lambda: None
    record(
        moving,
        {"wrapper": "moving-patch", "num_patches": 2, "size": [0.1, 0.3], "speed": 2.5},
        lambda w, drawn=drawn: drawn,
        steps,
    )

np.savez_compressed("wrappers.npz", cases=json.dumps(cases), **out)
