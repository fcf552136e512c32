"""Reads datasets with Python's `lance` and with the reader of the published `stable-worldmodel`, and prints the content
of each dataset as a line of JSON. `tests/it/reference.rs` compares these lines with the written episodes."""

import json
import sys

import lance
import numpy as np

from reference import LanceDataset


def to_list(values):
    return [None if np.isnan(v) else float(v) for v in np.asarray(values, dtype=np.float64).ravel()]


for path in sys.argv[1:]:
    table = lance.dataset(path)
    table.validate()
    arrow_table = table.to_table()
    dataset = LanceDataset(path, num_steps=2, frameskip=2)
    rows = LanceDataset(path)
    episodes = [rows.load_episode(e) for e in range(len(rows.lengths))]
    clip = dataset[1]
    content = {
        "rows": table.count_rows(),
        "episode_idx": arrow_table["episode_idx"].to_pylist(),
        "step_idx": arrow_table["step_idx"].to_pylist(),
        "lengths": [int(n) for n in dataset.lengths],
        "clips": len(dataset),
        "clip_action": to_list(clip["action"]),
        "clip_action_shape": list(clip["action"].shape),
        "clip_pixels_shape": list(clip["pixels"].shape),
        "columns": {
            name: to_list(np.concatenate([np.asarray(e[name]) for e in episodes]))
            for name in dataset.column_names
            if not name.startswith(("pixels", "goal"))
        },
        "pixel_means": [float(frame.double().mean()) for e in episodes for frame in e["pixels"]],
    }
    print(json.dumps(content))
