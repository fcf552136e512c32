"""Writes `broken.lance` beside this file: `episode_idx` 1 occurs in two consecutive episodes of two rows each."""

import pathlib

import lance
import numpy as np
import pyarrow as pa

episodes = np.array([0, 0, 0, 1, 1, 1, 1, 2, 2], np.int32)
steps = np.array([0, 1, 2, 0, 1, 0, 1, 0, 1], np.int32)
last = np.append(steps[1:] == 0, True)
actions = np.where(last, np.nan, 0.5).astype(np.float32)
column = lambda values: pa.FixedSizeListArray.from_arrays(pa.array(values, pa.float32()), 1)
table = pa.table({
    "episode_idx": episodes,
    "step_idx": steps,
    "action": column(actions),
    "reward": column(steps.astype(np.float32)),
})
lance.write_dataset(table, str(pathlib.Path(__file__).with_name("broken.lance")), mode="overwrite")
