"""Measures the LeWM of the reference implementation with given weights.

Arguments: the sizes as JSON, and a file of weights and inputs. Requests, one per line: `run WORK COUNT` or `outputs WORK`.
`WORK` is `cost` (the costs of the given candidates, with start and goal already encoded), `plan` (encoding, then CEM),
`encode` (one frame), `frames` (many frames at once) or `train` (one step, including the optimizer). Answers are lines that start with `SWM `; other
output of the reference is ignored. `torch` in the sizes says how PyTorch computes: `eager` or `compile`, then `-tf32` or `-bf16`.

The encoder of the reference is from another package, so this file contains a vision transformer with fused attention, and
the convolutional encoder of the preset `small`.
"""

import json
import sys
import time
from collections import OrderedDict
from importlib.metadata import version

import gymnasium as gym
import numpy as np
import torch
from stable_worldmodel.policy import PlanConfig
from stable_worldmodel.solver import CEMSolver
from stable_worldmodel.wm.lewm.lewm import LeWM
from stable_worldmodel.wm.lewm.module import MLP, Embedder, Predictor
from stable_worldmodel.wm.loss import SIGReg
from torch import nn

c = json.loads(sys.argv[1])  # The sizes of the model and of the benchmark.
given = torch.load(sys.argv[2], weights_only=True)
device = torch.device(c["device"])
how = c["torch"].split("-")
if "tf32" in how:
    torch.set_float32_matmul_precision("high")
precision = torch.autocast(device.type, torch.bfloat16, enabled="bf16" in how)


def tree(**parts):
    """A module with named parts."""
    module = nn.Module()
    for name, part in parts.items():
        setattr(module, name, part)
    return module


class Vit(nn.Module):
    def __init__(self):
        super().__init__()
        d, tokens = c["dim"], (c["image"] // c["patch"]) ** 2
        self.heads = c["vit_heads"]
        self.embeddings = tree(
            cls_token=nn.Parameter(torch.zeros(1, 1, d)),
            position_embeddings=nn.Parameter(torch.zeros(1, tokens + 1, d)),
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
        split = lambda t: t.unflatten(-1, (self.heads, -1)).transpose(1, 2)
        for layer in self.encoder.layer:
            y, qkv = layer.layernorm_before(x), layer.attention.attention
            q, k, v = split(qkv.query(y)), split(qkv.key(y)), split(qkv.value(y))
            mixed = nn.functional.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)
            x = x + layer.attention.output.dense(mixed)
            x = x + layer.output.dense(nn.functional.gelu(layer.intermediate.dense(layer.layernorm_after(x))))
        return tree(last_hidden_state=self.layernorm(x))


class Conv(nn.Module):
    def __init__(self):
        super().__init__()
        stage = lambda i, o: nn.Sequential(
            OrderedDict(conv=nn.Conv2d(i, o, 3, 2, 1, bias=False), norm=nn.BatchNorm2d(o), relu=nn.ReLU())
        )
        channels, side = c["channels"], c["image"]
        self.stages = nn.Sequential(*map(stage, [3, *channels], channels))
        for _ in channels:
            side = (side + 1) // 2
        if c["hidden"]:
            self.hidden = nn.Linear(side * side * channels[-1], c["hidden"])
        self.out = nn.Linear(c["hidden"] or side * side * channels[-1], c["dim"])
        # The layout in which PyTorch trains convolutions fastest on a CPU.
        self.to(memory_format=torch.channels_last)

    def forward(self, pixels, **_):
        x = self.stages(pixels.contiguous(memory_format=torch.channels_last)).flatten(1)
        x = self.out(self.hidden(x).relu() if c["hidden"] else x)
        return tree(last_hidden_state=x[:, None])


def lewm():
    latent, norm = c["latent"], nn.BatchNorm1d
    model = LeWM(
        encoder=Conv() if "channels" in c else Vit(),
        predictor=Predictor(
            num_frames=c["history"], depth=c["depth"], heads=c["heads"], mlp_dim=c["mlp"], input_dim=latent,
            hidden_dim=c["predictor_dim"], output_dim=latent, dim_head=c["dim_head"], dropout=c["dropout"],
        ),  # fmt: skip
        action_encoder=Embedder(c["actions"], c["actions"], latent),
        projector=MLP(c["dim"], c["proj_hidden"], latent, norm),
        pred_proj=MLP(latent, c["proj_hidden"], latent, norm),
    )
    weights = {name[2:]: value for name, value in given.items() if name.startswith("w.")}
    missing, unknown = model.load_state_dict(weights, strict=False)
    assert not unknown and all(name.endswith("num_batches_tracked") for name in missing), (missing, unknown)
    if "compile" in how:
        for name in ("encoder", "predictor", "action_encoder", "projector", "pred_proj"):
            getattr(model, name).compile(dynamic=False)
    return model.to(device)


model = lewm().eval()
pixels, goal, candidates = (given[f"i.{name}"].to(device) for name in ("pixels", "goal", "candidates"))
samples, horizon, actions = candidates.shape
envs = len(pixels)
solver = CEMSolver(
    model, batch_size=1, num_samples=samples, n_steps=c["iterations"], topk=c["elites"], device=device
)
space = gym.spaces.Box(-1.0, 1.0, shape=(envs, actions), dtype=np.float32)
solver.configure(action_space=space, n_envs=envs, config=PlanConfig(horizon=horizon, receding_horizon=horizon))
observation = lambda: {"pixels": pixels[:, None], "goal": goal[:, None], "action": torch.zeros(envs, 1, actions)}
expand = lambda x: x.to(device)[:, None].expand(1, samples, *x.shape[1:])
known = {name: expand(value[:1]) for name, value in observation().items()}


@torch.inference_mode()
@precision
def cost():
    return model.get_cost(known, candidates[None])


@torch.inference_mode()
@precision
def encode():
    return model.encode({"pixels": pixels[None, :1]})["emb"]


@torch.inference_mode()
@precision
def frames():
    model.encode({"pixels": pixels[None, :1].expand(c["frames"], -1, -1, -1, -1)})


@precision
def plan():
    solver.solve(observation())


class Training:
    """The published training step: prediction error and SIGReg, clipped gradients, AdamW."""

    def __init__(self):
        self.model = lewm().train()
        self.optimizer = torch.optim.AdamW(self.model.parameters(), lr=5e-5, weight_decay=1e-3)
        self.regulariser = SIGReg(c["knots"], c["directions"]).to(device)
        clips, steps = c["batch"], c["history"] + 1
        self.pixels = torch.randn(clips, steps, 3, c["image"], c["image"], device=device)
        self.actions = torch.randn(clips, steps, actions, device=device)

    def __call__(self):
        with precision:
            info = self.model.encode({"pixels": self.pixels, "action": self.actions})
            latents, conditions = info["emb"], info["act_emb"]
            predicted = self.model.predict(latents[:, :-1], conditions[:, :-1]).float()
        latents = latents.float()
        loss = (predicted - latents[:, 1:]).square().mean() + 0.09 * self.regulariser(latents.transpose(0, 1))
        loss.backward()
        nn.utils.clip_grad_norm_(self.model.parameters(), 1.0)
        self.optimizer.step()
        self.optimizer.zero_grad()
        return loss.item()


works = {"cost": cost, "encode": encode, "frames": frames, "plan": plan}


def run(work, count):
    if work == "train" and work not in works:
        works[work] = Training()
    begun = time.perf_counter()
    for _ in range(count):
        works[work]()
    if device.type == "cuda":
        torch.cuda.synchronize()
    return count, time.perf_counter() - begun


def answer(*words):
    print("SWM", *words, flush=True)


answer("ready", version("stable-worldmodel"), "torch", torch.__version__, c["torch"])
for line in sys.stdin:
    command, *arguments = line.rstrip("\n").split("\t")
    if command == "run":
        answer(*run(arguments[0], int(arguments[1])))
    else:
        answer(*works[arguments[0]]().flatten().tolist())
