"""Writes dino-wm-model-small.safetensors: inputs, weights, outputs and gradients of a very small DINO-WM.

Run with an interpreter that has torch, transformers and the reference package:

    python export_dino_wm.py dino-wm-model-small.safetensors

The reference's class `PreJEPA` computes encoding, prediction, rollout and cost. The loss follows the reference's
training script: all parts of a frame's embedding are predicted except the actions. The encoder is a tiny DINOv2 whose
position embeddings are for larger images.
"""

import json
import sys

import torch
from export_vit import published
from safetensors.torch import save_file
from stable_worldmodel.wm.prejepa.module import CausalPredictor, Embedder
from stable_worldmodel.wm.prejepa.prejepa import PreJEPA
from torch import nn
from transformers import Dinov2Config, Dinov2Model

CONFIG = dict(
    image=12, patch=4, dim=12, grid=5, vit_layers=2, vit_heads=2, vit_mlp=24, history=3, depth=2, heads=2, dim_head=4,
    mlp=16, columns=[["proprio", 3, 2], ["action", 4, 3]],
)  # fmt: skip


def main(path):
    torch.manual_seed(0)
    c = CONFIG
    encoder = Dinov2Config(
        hidden_size=c["dim"], num_hidden_layers=c["vit_layers"], num_attention_heads=c["vit_heads"], mlp_ratio=2,
        patch_size=c["patch"], image_size=c["grid"] * c["patch"],
    )  # fmt: skip
    patches = (c["image"] // c["patch"]) ** 2
    model = PreJEPA(
        encoder=Dinov2Model(encoder),
        predictor=CausalPredictor(
            num_patches=patches, num_frames=c["history"], dim=c["dim"] + sum(dim for _, _, dim in c["columns"]),
            depth=c["depth"], heads=c["heads"], mlp_dim=c["mlp"], dim_head=c["dim_head"],
        ),
        extra_encoders=nn.ModuleDict({k: Embedder(in_chans=n, emb_dim=dim) for k, n, dim in c["columns"]}),
        history_size=c["history"],
        interpolate_pos_encoding=False,  # DINOv2 always interpolates and has no such argument
    )  # fmt: skip
    with torch.no_grad():
        for value in model.parameters():
            value.add_(0.2 * torch.randn_like(value))
    model.eval()
    rename = lambda name: (
        "backbone." + published(name.removeprefix("backbone."), dino=True) if name.startswith("backbone.") else name
    )
    out = {f"w.{rename(name)}": value.clone() for name, value in model.state_dict().items()}

    clips, steps = 3, c["history"] + 1
    pixels = torch.randn(clips, steps, 3, c["image"], c["image"])
    columns = {name: torch.randn(clips, steps, elements) for name, elements, _ in c["columns"]}
    out |= {"i.pixels": pixels} | {f"i.{name}": value for name, value in columns.items()}

    info = model.encode(dict(pixels=pixels, **columns))
    embedding = info["emb"][:, : c["history"]]
    predicted = model.predict(embedding)
    target = info["emb"][:, 1:].detach()
    out |= {"o.emb": info["emb"], "o.pred": predicted}
    # The action embedding is the last part of a frame's embedding and is not predicted.
    free = info["emb"].shape[-1] - c["columns"][-1][2]
    loss = (predicted - target)[..., :free].square().mean()
    loss.backward()
    out |= {
        "o.loss": loss[None],
        "o.pixels_loss": (predicted - target)[..., : c["dim"]].square().mean()[None],
        "o.columns_loss": (predicted - target)[..., c["dim"] : free].square().mean()[None],
    }
    # The encoder is frozen (the model detaches its features), so its parameters have no gradients.
    out |= {f"g.{name}": value.grad for name, value in model.named_parameters() if value.grad is not None}

    # One environment with one frame of context; the horizon is longer than the history.
    samples, horizon = 4, 5
    candidates = torch.randn(1, samples, horizon, c["columns"][-1][1])
    goal = torch.randn(1, 1, 3, c["image"], c["image"])
    goal_proprio = torch.randn(1, 1, 3)
    repeat = lambda x: x[:, None].expand(1, samples, *x.shape[1:])
    info = dict(
        pixels=repeat(pixels[:1, :1]), proprio=repeat(columns["proprio"][:1, :1]), goal=repeat(goal),
        goal_proprio=repeat(goal_proprio), action=repeat(columns["action"][:1, :1]),
        id=torch.zeros(1, samples), step_idx=torch.zeros(1, samples),
    )  # fmt: skip
    with torch.no_grad():
        out["o.cost"] = model.get_cost(info, candidates)
    out["o.rollout"] = info["predicted_embedding"][0]
    out |= {"i.candidates": candidates[0], "i.goal": goal[0], "i.goal_proprio": goal_proprio}
    out = {name: value.detach().float().contiguous().clone() for name, value in out.items()}
    save_file(out, path, metadata={"config": json.dumps(c)})


main(sys.argv[1])
