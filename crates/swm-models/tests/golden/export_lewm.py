"""Writes lewm-small.safetensors: inputs, weights, outputs, losses and gradients of a very small LeWM.

Run with an interpreter that has torch and the reference package (`pip install stable-worldmodel torch`):

    python export_lewm.py lewm-small.safetensors

Model, rollout and cost come from the reference package. The encoder of the reference comes from another package, so
this script implements a vision transformer with the weight names of published checkpoints. `sigreg` implements SIGReg
for given directions.
"""

import json
import struct
import sys

import torch
from stable_worldmodel.wm.lewm.lewm import LeWM
from stable_worldmodel.wm.lewm.module import MLP, Embedder, Predictor
from torch import nn

CONFIG = dict(
    image=8, patch=4, dim=12, vit_layers=2, vit_heads=2, vit_mlp=16, history=3, depth=2, heads=2, dim_head=4,
    mlp=16, action_dim=4, proj_hidden=16, sigreg_weight=0.09, knots=17, num_proj=16,
)  # fmt: skip


def tree(**parts):
    """Returns a module with the submodules `parts`."""
    module = nn.Module()
    for name, part in parts.items():
        setattr(module, name, part)
    return module


class Vit(nn.Module):
    def __init__(self, c):
        super().__init__()
        d, tokens = c["dim"], (c["image"] // c["patch"]) ** 2
        self.heads = c["vit_heads"]
        self.embeddings = tree(
            cls_token=nn.Parameter(torch.randn(1, 1, d)),
            position_embeddings=nn.Parameter(torch.randn(1, tokens + 1, d)),
            patch_embeddings=tree(projection=nn.Conv2d(3, d, c["patch"], c["patch"])),
        )
        layers = [
            tree(
                layernorm_before=nn.LayerNorm(d, 1e-12),
                attention=tree(
                    attention=tree(query=nn.Linear(d, d), key=nn.Linear(d, d), value=nn.Linear(d, d)),
                    output=tree(dense=nn.Linear(d, d)),
                ),
                layernorm_after=nn.LayerNorm(d, 1e-12),
                intermediate=tree(dense=nn.Linear(d, c["vit_mlp"])),
                output=tree(dense=nn.Linear(c["vit_mlp"], d)),
            )
            for _ in range(c["vit_layers"])
        ]
        self.encoder = tree(layer=nn.ModuleList(layers))
        self.layernorm = nn.LayerNorm(d, 1e-12)

    def forward(self, pixels, **_):
        tokens = self.embeddings.patch_embeddings.projection(pixels).flatten(2).transpose(1, 2)
        class_token = self.embeddings.cls_token.expand(len(pixels), -1, -1)
        x = torch.cat([class_token, tokens], 1) + self.embeddings.position_embeddings
        for layer in self.encoder.layer:
            split = lambda t: t.unflatten(-1, (self.heads, -1)).transpose(1, 2)
            y, qkv = layer.layernorm_before(x), layer.attention.attention
            q, k, v = split(qkv.query(y)), split(qkv.key(y)), split(qkv.value(y))
            weights = (q @ k.transpose(-1, -2) / q.shape[-1] ** 0.5).softmax(-1)
            x = x + layer.attention.output.dense((weights @ v).transpose(1, 2).flatten(2))
            hidden = nn.functional.gelu(layer.intermediate.dense(layer.layernorm_after(x)))
            x = x + layer.output.dense(hidden)
        return tree(last_hidden_state=self.layernorm(x))


def sigreg(latents, directions, knots):
    """The regulariser of the reference (wm/loss.py) with given directions: the Epps-Pulley statistic, integrated by the
    trapezoidal rule."""
    t = torch.linspace(0, 3, knots)
    window = torch.exp(-t.square() / 2)
    angles = (latents @ directions).unsqueeze(-1) * t
    error = (angles.cos().mean(-3) - window).square() + angles.sin().mean(-3).square()
    return (torch.trapezoid(2 * error * window, t) * latents.shape[-2]).mean()


def main(path):
    torch.manual_seed(0)
    c = CONFIG
    norm = nn.BatchNorm1d
    model = LeWM(
        encoder=Vit(c),
        predictor=Predictor(
            num_frames=c["history"], depth=c["depth"], heads=c["heads"], mlp_dim=c["mlp"], input_dim=c["dim"],
            hidden_dim=c["dim"], dim_head=c["dim_head"],
        ),  # fmt: skip
        action_encoder=Embedder(c["action_dim"], c["action_dim"], c["dim"]),
        projector=MLP(c["dim"], c["proj_hidden"], c["dim"], norm),
        pred_proj=MLP(c["dim"], c["proj_hidden"], c["dim"], norm),
    )
    # Initial values (zero modulations, unit scales, default statistics) could hide errors, so noise is added.
    with torch.no_grad():
        for name, value in model.state_dict().items():
            if name.endswith("running_var"):
                value.copy_(torch.rand_like(value) + 0.5)
            elif value.is_floating_point():
                value.add_(0.1 * torch.randn_like(value))

    clips, steps, envs, samples, horizon = 4, 4, 2, 3, 5
    pixels = torch.randn(clips, steps, 3, c["image"], c["image"])
    action = torch.randn(clips, steps, c["action_dim"])
    goal = torch.randn(envs, 1, 3, c["image"], c["image"])
    candidates = torch.randn(envs, samples, horizon, c["action_dim"])
    directions = nn.functional.normalize(torch.randn(c["dim"], c["num_proj"]), dim=0)
    out = {
        "i.pixels": pixels, "i.action": action, "i.goal": goal, "i.candidates": candidates,
        "i.sigreg_projections": directions,
    }  # fmt: skip
    out |= {f"w.{name}": value.clone() for name, value in model.state_dict().items()}

    model.eval()
    with torch.no_grad():
        info = model.encode({"pixels": pixels, "action": action})
        emb, act = info["emb"], info["act_emb"]
        out |= {"o.eval.emb": emb, "o.eval.act_emb": act}
        out["o.eval.pred"] = model.predict(emb[:, : c["history"]], act[:, : c["history"]])
        # One environment at a time, because the reference cannot broadcast the goals of several environments.
        for history in (1, 3):
            costs, rollouts = [], []
            for env in range(envs):
                repeat = lambda x: x[None, None].expand(1, samples, *x.shape)
                sequence = torch.cat([repeat(action[env, : history - 1]), candidates[env][None]], 2)
                info = {"pixels": repeat(pixels[env, :history]), "goal": repeat(goal[env]), "action": sequence[:, :, :1]}
                costs.append(model.get_cost(info, sequence))
                rollouts.append(info["predicted_emb"])
            out |= {f"o.cost.h{history}": torch.cat(costs), f"o.rollout.h{history}": torch.cat(rollouts)}

    model.train()
    info = model.encode({"pixels": pixels, "action": action})
    emb, act, h = info["emb"], info["act_emb"], c["history"]
    prediction = (model.predict(emb[:, :h], act[:, :h]) - emb[:, 1 : h + 1]).square().mean()
    regulariser = sigreg(emb.transpose(0, 1), directions, c["knots"])
    loss = prediction + c["sigreg_weight"] * regulariser
    loss.backward()
    out |= {"o.train.emb": emb, "o.train.loss": loss[None], "o.train.pred_loss": prediction[None]}
    out["o.train.sigreg_loss"] = regulariser[None]
    out |= {f"g.{name}": parameter.grad for name, parameter in model.named_parameters()}

    header, data = {"__metadata__": {"config": json.dumps(c)}}, b""
    for name, value in sorted(out.items()):
        if not value.is_floating_point():
            continue
        raw = value.detach().contiguous().numpy().tobytes()
        header[name] = {"dtype": "F32", "shape": list(value.shape), "data_offsets": [len(data), len(data) + len(raw)]}
        data += raw
    text = json.dumps(header).encode()
    with open(path, "wb") as file:
        file.write(struct.pack("<Q", len(text)) + text + data)


if __name__ == "__main__":
    main(sys.argv[1])
