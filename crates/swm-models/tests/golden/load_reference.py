"""Loads an exported checkpoint with the reference's `load_pretrained` and compares the outputs with recorded outputs.

    python load_reference.py CHECKPOINT reference-lewm.safetensors
"""

import sys
import tempfile
from pathlib import Path

import torch
from safetensors.torch import load_file
from stable_worldmodel.wm.utils import load_pretrained


@torch.no_grad()
def main(checkpoint, recorded):
    torch.load(Path(checkpoint) / "weights.pt", weights_only=True)
    with tempfile.TemporaryDirectory() as cache:
        (Path(cache) / "checkpoints").mkdir()
        (Path(cache) / "checkpoints" / "run").symlink_to(Path(checkpoint).resolve())
        model = load_pretrained("run", cache_dir=cache).eval()
    recorded = load_file(recorded)
    info = model.encode(dict(pixels=recorded["i.pixels"], action=recorded["i.action"]))
    predicted = model.predict(info["emb"], info["act_emb"])
    for actual, expected in [(info["emb"], recorded["o.emb"]), (predicted, recorded["o.pred"])]:
        error = (actual - expected).abs().max() / expected.abs().max()
        assert error < 1e-5, f"differs by {error:.1e}"


main(*sys.argv[1:])
