"""Reads a folder dataset of this project with the reference's reader, and prints the content as a line of JSON. Needs
torch and Pillow."""

import json
import sys

from stable_worldmodel.data.formats.folder import FolderDataset

data = FolderDataset(path=sys.argv[1], num_steps=2, frameskip=2)
clip = data[len(data) - 1]
print(json.dumps({
    "lengths": [int(n) for n in data.lengths],
    "clips": len(data),
    "columns": data.column_names,
    "pixels": clip["pixels"].double().mean(dim=(1, 2, 3)).tolist(),
    "state": clip["state"].tolist(),
}))
