"""Opens a dataset with LeRobot's own package and prints its rows as JSON. `tests/it/lerobot.rs` compares
the rows with the written episodes."""

import json
import os
import sys

os.environ["HF_HUB_OFFLINE"] = "1"

from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: E402

dataset = LeRobotDataset("test/ours", root=sys.argv[1], video_backend="torchcodec")
assert set(dataset.meta.stats) >= {"action", "observation.state", "observation.images.pixels"}
rows = []
for i in range(len(dataset)):
    row = dataset[i]
    image = lambda name: (row["observation.images." + name] * 255).round().permute(1, 2, 0).flatten().int().tolist()
    rows.append(
        {
            "state": row["observation.state"].tolist(),
            "action": row["action"].tolist(),
            "task": row["task"],
            "episode_index": int(row["episode_index"]),
            "frame_index": int(row["frame_index"]),
            "pixels": image("pixels"),
            "goal": image("goal"),
        }
    )
print(json.dumps({"episodes": dataset.num_episodes, "rows": rows}))
