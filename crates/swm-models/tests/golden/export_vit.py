"""Writes vit-*.safetensors and dinov2-*.safetensors: inputs, weights, tokens and gradients of very small backbones.

Run with an interpreter that has torch and transformers:

    python export_vit.py FOLDER

Weights are written under the names of published checkpoints (those of transformers 4; transformers 5 renames weights
when it loads a checkpoint). Each file has images of the model's size (`i.pixels`) and of another size (`i.other`), the
tokens of all images, and the gradients of the mean square of the tokens of `i.other`.
"""

import json
import re
import sys
from pathlib import Path

import torch
from safetensors.torch import save_file
from transformers import (
    Dinov2Config,
    Dinov2Model,
    Dinov2WithRegistersConfig,
    Dinov2WithRegistersModel,
    ViTConfig,
    ViTModel,
)

SIZE = dict(hidden_size=12, num_hidden_layers=2, num_attention_heads=2, patch_size=4)


QKV = dict(q="query", k="key", v="value")


def published(name, dino):
    """The name of a parameter in published files."""
    name = re.sub(r"\.attention\.([qkv])_proj\.", lambda m: f".attention.attention.{QKV[m[1]]}.", name)
    name = name.replace(".attention.o_proj.", ".attention.output.dense.")
    if not dino:
        name = re.sub(r"^layers\.", "encoder.layer.", name)
        name = name.replace(".mlp.fc1.", ".intermediate.dense.").replace(".mlp.fc2.", ".output.dense.")
    return name


def write(path, model, dino, config):
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(parameter + 0.3 * torch.randn(parameter.shape, generator=generator))
    model.eval()
    pixels = torch.randn(2, 3, config["image"], config["image"], generator=generator)
    other = torch.randn(2, 3, config["other"], config["other"], generator=generator)
    interpolate = {} if dino else dict(interpolate_pos_encoding=True)
    tokens = model(pixels).last_hidden_state
    resized = model(other, **interpolate).last_hidden_state
    resized.square().mean().backward()
    rename = lambda name: published(name, dino)
    tensors = {"i.pixels": pixels, "i.other": other, "o.tokens": tokens, "o.other": resized}
    tensors |= {f"w.{rename(name)}": value for name, value in model.state_dict().items()}
    # The mask token has no gradient, because the model does not use it.
    grads = {name: value.grad for name, value in model.named_parameters() if value.grad is not None}
    tensors |= {f"g.{rename(name)}": value for name, value in grads.items()}
    tensors = {name: value.detach().contiguous().clone() for name, value in tensors.items()}
    save_file(tensors, path, metadata={"config": json.dumps(config)})


def main(folder):
    sizes = dict(patch=4, dim=12, depth=2, heads=2)
    vit = ViTModel(ViTConfig(**SIZE, intermediate_size=16, image_size=16), add_pooling_layer=False)
    write(folder / "vit-small.safetensors", vit, False, dict(**sizes, mlp=16, image=16, other=24))
    dino = dict(SIZE, image_size=20, mlp_ratio=2)
    settings = dict(**sizes, mlp=24, image=20, grid=5)
    model = Dinov2Model(Dinov2Config(**dino))
    write(folder / "dinov2-small.safetensors", model, True, dict(**settings, registers=0, other=12))
    model = Dinov2WithRegistersModel(Dinov2WithRegistersConfig(**dino, num_register_tokens=2))
    write(folder / "dinov2-registers.safetensors", model, True, dict(**settings, registers=2, other=12))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
