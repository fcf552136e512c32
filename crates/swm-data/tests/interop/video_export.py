"""Writes `reference-video` with the writer of the published `stable-worldmodel`, and the frames that its reader
(decord) returns. `tests/it/video.rs` compares these frames with the frames that this project
reads.

python video_export.py    (stable-worldmodel 0.1.1, imageio-ffmpeg, decord 0.6.0)
"""

import shutil
from pathlib import Path

import numpy as np
from PIL import Image

import reference  # noqa: F401
from stable_worldmodel.data.formats.video import VideoDataset, VideoWriter

LENGTHS = [11, 14, 9]


def episode(e):
    rows = range(LENGTHS[e])
    y, x = np.mgrid[:48, :64]
    frames = []
    for t in rows:
        frame = np.stack([3 * y + 40 * e, 3 * x, 0 * x + 60 + 10 * t], -1).clip(0, 255).astype(np.uint8)
        frame[4 + t : 12 + t, 8 + 2 * t : 20 + 2 * t] = [250, 220 - 50 * e, 20]
        frames.append(frame)
    action = [np.array([e, t / 4], np.float32) for t in rows]
    action[-1] = np.full(2, np.nan, np.float32)
    return {
        "pixels": frames,
        "action": action,
        "state": [np.array([e, t, -0.5]) for t in rows],
        "step_idx": [np.int64(t) for t in rows],
        "success": [np.bool_(t % 3 == 0) for t in rows],
    }


here = Path(__file__).parent
path = here / "reference-video"
shutil.rmtree(path, ignore_errors=True)
with VideoWriter(path, mode="error") as writer:
    writer.write_episodes(episode(e) for e in range(len(LENGTHS)))
dataset = VideoDataset(path=path, video_keys=["pixels"])
frames = []
for e, length in enumerate(LENGTHS):
    pixels = dataset._load_slice(e, 0, length)["pixels"].numpy().transpose(0, 2, 3, 1)
    frames += [pixels[t] for t in [0, 2, length - 1]]
Image.fromarray(np.concatenate(frames)).save(here / "reference-video-pixels.png")
