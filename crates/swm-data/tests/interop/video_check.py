"""Opens a folder of videos with the reader of the published `stable-worldmodel` (decord), and prints what it sees as
JSON: what `video.rs` compares.
"""

import json
import sys

import reference  # noqa: F401
from stable_worldmodel.data.formats.video import Video

path = sys.argv[1]
assert Video.detect(path)
dataset = Video.open_reader(path, video_keys=["pixels"])
episodes = []
for e, length in enumerate(dataset.lengths):
    seen = dataset._load_slice(e, 0, int(length))
    episode = {"pixels": seen["pixels"].permute(0, 2, 3, 1).flatten().tolist()}
    episode["state"] = seen["state"].flatten().tolist()
    episodes.append(episode)
print(json.dumps(episodes))
