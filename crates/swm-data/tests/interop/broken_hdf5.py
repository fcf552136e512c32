"""Writes `broken.h5` beside this file: the steps of the second episode restart at row 2, and the last two
episodes share a row."""

import pathlib

import h5py
import numpy as np

steps = np.array([0, 1, 2, 0, 1, 0, 1, 0, 1, 2], np.int64)
lengths, offsets = np.array([3, 4, 2, 2], np.int32), np.array([0, 3, 7, 8], np.int64)
actions = np.full((10, 1), 0.5, np.float32)
with h5py.File(pathlib.Path(__file__).with_name("broken.h5"), "w") as file:
    for name, values in {"ep_len": lengths, "ep_offset": offsets, "step_idx": steps, "action": actions}.items():
        file[name] = values
