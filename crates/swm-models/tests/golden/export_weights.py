"""Writes weights-*: one state dict in the formats of torch.save and as safetensors files.

Run with an interpreter that has torch and safetensors:

    python export_weights.py FOLDER
"""

import sys
from collections import OrderedDict
from pathlib import Path

import torch
from safetensors.torch import save_file


def main(folder):
    torch.manual_seed(0)
    base = torch.randn(4, 6)
    state = OrderedDict(
        {
            "single.weight": base,
            "single.column": base[:, 1],  # a strided view of `base`
            "single.transposed": base.t(),
            "half.weight": torch.randn(3, 2).half(),
            "brain.weight": torch.randn(5).bfloat16(),
            "double.weight": torch.randn(2, 2).double(),
            "norm.num_batches_tracked": torch.tensor(7),
            "mask": torch.tensor([True, False, True]),
        }
    )
    torch.save(state, folder / "weights-zip.pt")
    torch.save(state, folder / "weights-legacy.pth", _use_new_zipfile_serialization=False)
    torch.save({"state_dict": state, "epoch": 3, "name": "run"}, folder / "weights-training.ckpt")
    save_file({name: value.contiguous().clone() for name, value in state.items()}, folder / "weights-same.safetensors")
    single = {name: value.float().contiguous().clone() for name, value in state.items()}
    save_file(single, folder / "weights-single.safetensors")


main(Path(sys.argv[1]))
