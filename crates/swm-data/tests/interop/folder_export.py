"""Writes the folder dataset next to this script with the writer of the reference implementation, and adds a column and
an image in the forms that other programs write. Needs numpy, Pillow, and the published `stable-worldmodel`."""

import shutil
from pathlib import Path

import numpy as np
from PIL import Image
from stable_worldmodel.data.formats.folder import FolderWriter

here = Path(__file__).parent
lengths = [2, 3]
rows = sum(lengths)


def images():
    t, y, x = np.mgrid[0:rows, 0:16, 0:24]
    return np.stack([8 * y + t, 4 * x + 7 * t, 90 + 0 * x], -1).astype(np.uint8)


shutil.rmtree(here / "folder-reference", ignore_errors=True)
with FolderWriter(here / "folder-reference", mode="overwrite") as writer:
    first = 0
    for length in lengths:
        part = slice(first, first + length)
        t = np.arange(first, first + length)
        action = np.stack([t / 4, -t], -1).astype("f4")
        action[-1] = np.nan
        columns = {"pixels": images()[part], "action": action, "reward": t * 0.5, "variation.agent": np.stack([t] * 3, -1)}
        columns["task"] = np.array(["push"] * length)
        writer.write_episode({name: list(values) for name, values in columns.items()})
        first += length
# Other programs may compress arrays, store other types, and save lossless images with another suffix.
np.savez_compressed(here / "folder-reference/small.npz", np.arange(rows, dtype=">i2") - 3)
Image.fromarray(images()[0]).save(here / "folder-reference/pixels/ep_0_step_0.png")
(here / "folder-reference/pixels/ep_0_step_0.jpeg").unlink()
