"""Writes pldm-model-small.safetensors: inputs, weights, outputs, losses and gradients of a very small PLDM.

Run with an interpreter that has torch, transformers and the reference package:

    python export_pldm.py pldm-model-small.safetensors

Model, rollout, cost and loss terms come from the reference package. The sum of the terms follows the reference's
training script: the input of the inverse dynamics is the next latent, then the present latent. Weights have their
published names below `model.` and `idm.`.
"""

import json
import sys

import torch
from export_vit import published
from safetensors.torch import save_file
from stable_worldmodel.wm.loss import PLDMLoss, TemporalStraighteningLoss
from stable_worldmodel.wm.pldm.module import MLP, Embedder, Predictor
from stable_worldmodel.wm.pldm.pldm import PLDM
from torch import nn
from transformers import ViTConfig, ViTModel

CONFIG = dict(
    image=8, patch=4, dim=12, latent=6, vit_layers=2, vit_heads=2, vit_mlp=16, history=3, depth=2, heads=2, dim_head=4,
    mlp=16, action_dim=4, proj_hidden=16, idm_hidden=10,
    weights=dict(std=18.0, std_t=0.7, cov=12.0, cov_t=0.3, temp_align=0.2, idm=0.4, temp_straight=0.1),
)  # fmt: skip


def build(c):
    encoder = ViTConfig(
        hidden_size=c["dim"], num_hidden_layers=c["vit_layers"], num_attention_heads=c["vit_heads"],
        intermediate_size=c["vit_mlp"], patch_size=c["patch"], image_size=c["image"],
    )  # fmt: skip
    project = lambda inputs: MLP(inputs, c["proj_hidden"], c["latent"], norm_fn=nn.BatchNorm1d)
    model = PLDM(
        encoder=ViTModel(encoder, add_pooling_layer=False),
        predictor=Predictor(
            num_frames=c["history"], depth=c["depth"], heads=c["heads"], mlp_dim=c["mlp"], input_dim=c["latent"],
            hidden_dim=c["dim"], output_dim=c["latent"], dim_head=c["dim_head"],
        ),
        action_encoder=Embedder(input_dim=c["action_dim"], smoothed_dim=c["action_dim"], emb_dim=c["latent"]),
        projector=project(c["dim"]),
        pred_proj=project(c["latent"]),
    )  # fmt: skip
    idm = MLP(2 * c["latent"], c["idm_hidden"], c["action_dim"])
    return nn.ModuleDict(dict(model=model, idm=idm))


def main(path):
    torch.manual_seed(0)
    c = CONFIG
    parts = build(c)
    # Zero-initialised parameters could hide errors, so noise is added.
    with torch.no_grad():
        for value in parts.parameters():
            value.add_(0.2 * torch.randn_like(value))
        for name, value in parts.named_buffers():
            if name.endswith("running_mean"):
                value.copy_(0.1 * torch.randn_like(value))
            if name.endswith("running_var"):
                value.copy_(0.5 + torch.rand_like(value))
    model, idm = parts["model"], parts["idm"]
    rename = lambda name: name if "encoder." not in name or "action_encoder" in name else (
        "model.encoder." + published(name.removeprefix("model.encoder."), dino=False)
    )
    tensors = {f"w.{rename(k)}": v.clone() for k, v in parts.state_dict().items() if "tracked" not in k}

    clips, steps = 6, c["history"] + 1
    pixels = torch.randn(clips, steps, 3, c["image"], c["image"])
    action = torch.randn(clips, steps, c["action_dim"])
    tensors |= {"i.pixels": pixels, "i.action": action}

    model.eval()
    info = model.encode(dict(pixels=pixels, action=action))
    tensors["o.eval.emb"] = info["emb"]
    tensors["o.eval.pred"] = model.predict(info["emb"][:, : c["history"]], info["act_emb"][:, : c["history"]])
    # One environment only, because the published cost does not broadcast the goals of several environments.
    samples, horizon = 5, 3
    candidates = torch.randn(1, samples, horizon, c["action_dim"])
    goal = torch.randn(1, 1, 3, c["image"], c["image"])
    spread = lambda x: x[:, None].expand(-1, samples, *x.shape[1:])
    info = dict(pixels=spread(pixels[:1, :1]), goal=spread(goal), action=spread(action[:1, :1]))
    tensors["o.cost"] = model.get_cost(info, candidates)
    tensors["o.rollout"] = info["predicted_emb"][0]
    tensors |= {"i.candidates": candidates[0], "i.goal": goal[0]}

    parts.train()
    info = model.encode(dict(pixels=pixels, action=action))
    emb, act = info["emb"], info["act_emb"]
    pred = model.predict(emb[:, : c["history"]], act[:, : c["history"]])
    losses = dict(pred_loss=(pred - emb[:, 1:]).square().mean())
    action_pred = idm(torch.cat([emb[:, 1:], emb[:, :-1]], -1))
    losses |= PLDMLoss()(emb, action_pred, action[:, :-1])
    losses["temp_straight_loss"] = TemporalStraighteningLoss()(emb)
    loss = losses["pred_loss"] + sum(w * losses[f"{name}_loss"] for name, w in c["weights"].items())
    loss.backward()
    tensors["o.train.emb"] = emb
    tensors["o.train.loss"] = loss[None]
    tensors |= {f"o.train.{name}": value[None] for name, value in losses.items()}
    tensors |= {f"g.{rename(k)}": v.grad for k, v in parts.named_parameters() if v.grad is not None}
    tensors = {name: value.detach().float().contiguous().clone() for name, value in tensors.items()}
    save_file(tensors, path, metadata={"config": json.dumps(c)})


main(sys.argv[1])
