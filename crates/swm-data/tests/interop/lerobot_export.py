"""Writes small datasets with LeRobot's own package, and the frames that the package reads back from them.
`tests/it/lerobot.rs` compares these frames with the frames that this project reads.

python lerobot_export.py NAME CODEC    (lerobot 0.4.4 writes v3.0, lerobot 0.3.3 writes v2.1)
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from lerobot.datasets.lerobot_dataset import LeRobotDataset

LENGTHS = [11, 14, 9]
TASKS = ["push the block", "open the drawer", "push the block"]


def image(e, t, height, width):
    y, x = np.mgrid[:height, :width]
    pixels = np.stack([3 * y + 40 * e, 3 * x, 0 * x + 60 + 10 * t], -1).clip(0, 255).astype(np.uint8)
    pixels[4 + t : 12 + t, 8 + 2 * t : 20 + 2 * t] = [250, 220 - 50 * e, 20]
    return pixels


def frame(e, t, images):
    row = {
        "observation.state": np.array([e, t, -0.5], np.float32),
        "action": np.array([e + t / 4, -t], np.float32),
        "next.reward": np.array([t / 2], np.float32),
        "next.done": np.array([t == LENGTHS[e] - 1]),
        "observation.images.top": image(e, t, 48, 64),
        "observation.images.wrist": image(e, 2 * t, 48, 48),
    }
    if images:
        row["observation.images.still"] = image(e, t, 24, 32)
    return row


def main(name, codec):
    here = Path(__file__).parent
    root = here / name
    camera = lambda dtype, h, w: {"dtype": dtype, "shape": (h, w, 3), "names": ["height", "width", "channels"]}
    features = {
        "observation.state": {"dtype": "float32", "shape": (3,), "names": ["a", "b", "c"]},
        "action": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
        "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
        "next.done": {"dtype": "bool", "shape": (1,), "names": None},
        "observation.images.top": camera("video", 48, 64),
        "observation.images.wrist": camera("video", 48, 48),
    }
    images = codec == "h264"
    if images:
        features["observation.images.still"] = camera("image", 24, 32)
    options = {"vcodec": codec} if codec != "default" else {}
    dataset = LeRobotDataset.create("test/" + name, fps=10, features=features, root=root, robot_type="arm", **options)
    for e, length in enumerate(LENGTHS):
        for t in range(length):
            row = frame(e, t, images)
            try:
                dataset.add_frame({**row, "task": TASKS[e]})
            except TypeError:  # before 0.4, the task was a separate argument
                dataset.add_frame(row, task=TASKS[e])
        dataset.save_episode()
    if hasattr(dataset, "finalize"):
        dataset.finalize()
    # The first, third and last frame of every episode, as the package decodes them, one below the other.
    dataset = LeRobotDataset("test/" + name, root=root, video_backend="torchcodec")
    for camera in ["top", "wrist"]:
        frames, first = [], 0
        for length in LENGTHS:
            for t in [0, 2, length - 1]:
                pixels = dataset[first + t]["observation.images." + camera].numpy()
                frames.append((pixels * 255).round().astype(np.uint8).transpose(1, 2, 0))
            first += length
        Image.fromarray(np.concatenate(frames)).save(here / f"{name}-{camera}.png")


main(*sys.argv[1:])
