"""Writes gcbc-small.safetensors, gcivl-small.safetensors and gciql-small.safetensors: inputs, weights, losses and
gradients of very small goal-conditioned models. Also writes reference/gcivl, a checkpoint in the form of the published
training script.

Run with an interpreter that has torch and the reference package (`pip install stable-worldmodel torch`):

    python export_gcrl.py FOLDER

Model, heads and expectile loss come from the reference package (`wm/gcrl`). The package holds no training code, so this
script implements the losses of the algorithms in the paper's appendix (GCBC, GCIVL and GCIQL training), with the
additions of the published training scripts: the weight of an action is at most 100, the policy is a normal distribution
with one trained standard deviation per element, and the value head pools tokens by their mean. Values and policy are
trained together: the policy's loss has no gradient to encoder and values, so the gradients equal the gradients of the
paper's two training phases.
"""

import json
import os
import struct
import sys

import torch
from export_lewm import Vit
from stable_worldmodel.wm.gcrl.gcrl import GCRL
from stable_worldmodel.wm.gcrl.module import ExpectileLoss, Predictor, QPredictor
from torch import nn

CONFIG = dict(
    image=8, patch=4, dim=12, vit_layers=1, vit_heads=2, vit_mlp=16, history=3, depth=3, heads=2, dim_head=4, mlp=16,
    action_dim=4, critic_hidden=16, discount=0.9, expectile=0.7, temperature=3.0,
)  # fmt: skip


class TeacherStudent(nn.Module):
    """A network and its target network, under the names of the published training scripts."""

    def __init__(self, make):
        super().__init__()
        self.student, self.teacher = make(), make()


def flat(embedding):
    """Flattens [rows, frames, patches, dim] to [rows, frames * patches, dim]."""
    return embedding.flatten(1, 2)


def save(model, folder):
    """Writes the state dict and the settings in the form of the published training script."""
    c = CONFIG
    sizes = dict(depth=c["depth"], heads=c["heads"], mlp_dim=c["mlp"], dim_head=c["dim_head"], dropout=0.0)
    settings = dict(
        image_size=c["image"], patch_size=c["patch"], frameskip=2, dinowm=dict(history_size=c["history"], action_dim=2),
        predictor=sizes, encoder=dict(num_attention_heads=c["vit_heads"]),
    )  # fmt: skip
    os.makedirs(folder, exist_ok=True)
    torch.save(model.state_dict(), os.path.join(folder, "weights.pt"))
    with open(os.path.join(folder, "config.json"), "w") as file:
        json.dump(settings, file, indent=2)


def main(family, path):
    torch.manual_seed(["gcbc", "gcivl", "gciql"].index(family))
    c = CONFIG
    size = dict(
        num_patches=(c["image"] // c["patch"]) ** 2, num_frames=c["history"], dim=c["dim"], depth=c["depth"],
        heads=c["heads"], mlp_dim=c["mlp"], dim_head=c["dim_head"],
    )  # fmt: skip
    parts = {}
    if family != "gcbc":
        parts["value_predictor"] = TeacherStudent(lambda: Predictor(out_dim=1, pool_type="mean", **size))
    if family == "gciql":
        parts["critic_predictor"] = TeacherStudent(
            lambda: QPredictor(
                action_dim=c["action_dim"], q_hidden_dim=c["critic_hidden"], pool_type="mean", **size
            )
        )
    model = GCRL(encoder=Vit(c), action_predictor=Predictor(out_dim=c["action_dim"], **size), **parts)
    # Initial values such as zeros and ones could hide errors, so noise is added.
    with torch.no_grad():
        for value in model.state_dict().values():
            if value.is_floating_point():
                value.add_(0.1 * torch.randn_like(value))

    clips, history = 3, c["history"]
    steps = history if family == "gcbc" else history + 1
    pixels = torch.randn(clips, steps, 3, c["image"], c["image"])
    action = torch.randn(clips, steps, c["action_dim"])
    goal = torch.randn(clips, 1, 3, c["image"], c["image"])
    goal[0, 0] = pixels[0, history - 1]  # the last observation of clip 0 equals the goal
    actor_goal = torch.randn_like(goal)
    out = {"i.pixels": pixels, "i.action": action, "i.goal": goal}
    out |= {f"w.{name}": value.clone() for name, value in model.state_dict().items()}
    if family == "gcivl":
        save(model, os.path.join(os.path.dirname(path), "reference", family))

    encode = lambda x: model.encode({"pixels": x}, emb_keys=[])["embed"]
    embed, goal_embed = encode(pixels), encode(goal)
    taken = action[:, :history]
    if family == "gcbc":
        means, _ = model.predict_actions(embed, goal_embed)
        loss = nn.functional.mse_loss(means, taken)
        out["o.loss"] = loss[None]
    else:
        now, later, goals = flat(embed[:, :history]), flat(embed[:, 1:]), flat(goal_embed)
        reached = (pixels[:, :history] == goal).all((2, 3, 4)).float().unsqueeze(-1)
        not_reached = 1 - reached
        value = model.value_predictor.student(now, goals)
        with torch.no_grad():
            target = c["discount"] * not_reached * model.value_predictor.teacher(later, goals) - not_reached
        critic_loss = torch.zeros(())
        if family == "gciql":
            critic = model.critic_predictor.student(now, taken, goals)
            critic_loss = (critic - target).square().mean()
            with torch.no_grad():
                target = model.critic_predictor.teacher(now, taken, goals)
            out["o.critic_loss"] = critic_loss[None]
        value_loss = ExpectileLoss(c["expectile"])(value, target)

        with torch.no_grad():
            actor_embed = encode(actor_goal)
            goals = flat(actor_embed)
            if family == "gciql":
                after = model.critic_predictor.student(now, taken, goals)
            else:
                after = model.value_predictor.student(later, goals)
            advantage = after - model.value_predictor.student(now, goals)
            weight = (c["temperature"] * advantage).exp().clamp(max=100)
        means, stds = model.predict_actions(embed[:, :history].detach(), actor_embed)
        policy_loss = (weight * (stds.log() + (taken - means).square() / stds.square() / 2)).mean()
        loss = value_loss + critic_loss + policy_loss
        out |= {"i.actor_goal": actor_goal, "i.reached": reached, "o.value": value.mean()[None]}
        out |= {"o.weight": weight.mean()[None], "o.value_loss": value_loss[None], "o.policy_loss": policy_loss[None]}
        out["o.loss"] = loss[None]
    loss.backward()
    out |= {f"g.{name}": p.grad for name, p in model.named_parameters() if p.grad is not None}

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
    for family in ("gcbc", "gcivl", "gciql"):
        main(family, os.path.join(sys.argv[1], f"{family}-small.safetensors"))
