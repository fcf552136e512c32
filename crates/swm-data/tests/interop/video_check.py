"""Opens a folder of videos with the reader of the published `stable-worldmodel` (decord), and prints the frames and
states of every episode as JSON. `tests/it/video.rs` compares the output with the written episodes.
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
    read = dataset._load_slice(e, 0, int(length))
    episode = {"pixels": read["pixels"].permute(0, 2, 3, 1).flatten().tolist()}
    episode["state"] = read["state"].flatten().tolist()
    episodes.append(episode)
print(json.dumps(episodes))
