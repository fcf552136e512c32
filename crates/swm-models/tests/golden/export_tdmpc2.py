"""Writes tdmpc2-train.safetensors: the training losses and gradients of the published TD-MPC2 at a very small size.

Run with an interpreter that has torch and the reference package (`pip install stable-worldmodel torch`):

    python export_tdmpc2.py tdmpc2-train.safetensors

Model and loss come from the reference package (`wm/tdmpc2`). The random draws of the reference (noise and pairs of Q
functions) are recorded; dropout is off. The reference bootstraps after terminations, so `o.terminated.*` additionally
contains the loss of a batch with terminations, in which the value of the next frame is multiplied by 0, as in the
publication of SAC and the later official TD-MPC2.
"""

import json
import random
import struct
import sys
from types import SimpleNamespace

import torch
from stable_worldmodel.wm.tdmpc2 import tdmpc2 as reference

CONFIG = dict(
    action_dim=2, extra_dims=dict(state=3, speed=2), image_size=0,
    wm=dict(
        tau=0.1, encoding=dict(state=8, speed=8), enc_dim=12, mlp_dim=16, num_bins=11, vmin=-3, vmax=3, num_q=4,
        simnorm_dim=4, discount=0.97, uncertainty_penalty=0.5, horizon=3, rho=0.5, entropy_coef=0.01,
        consistency_coef=20.0, reward_coef=0.1, value_coef=0.1,
    ),
)  # fmt: skip
CLIPS = 5


class Config(dict):
    """A dictionary with its keys as attributes, as the reference requires."""

    def __getattr__(self, name):
        value = self[name]
        return Config(value) if isinstance(value, dict) else value


def record(model, config, batch, out, prefix):
    """Computes losses and gradients; adds the losses and the random draws to `out`."""
    noise, pairs, scalars = [], [], {}
    draw, choose = torch.randn_like, random.sample
    reference.torch.randn_like = lambda x: noise.append(draw(x)) or noise[-1]
    reference.random.sample = lambda population, k: pairs.append(choose(population, k)) or pairs[-1]
    context = SimpleNamespace(model=model, log_dict=lambda values, **_: scalars.update(values))
    model.zero_grad()
    loss = reference.tdmpc2_forward(context, batch, "validate", config)["loss"]
    loss.backward()
    reference.torch.randn_like, reference.random.sample = draw, choose
    # Every step draws for the target first, then for the policy.
    pairs = torch.tensor(pairs, dtype=torch.float32)
    out[f"{prefix}.target_noise"], out[f"{prefix}.policy_noise"] = torch.stack(noise[::2]), torch.stack(noise[1::2])
    out[f"{prefix}.target_critics"], out[f"{prefix}.policy_critics"] = pairs[::2], pairs[1::2]
    out |= {f"{prefix}.{name.split('/')[1]}": value.reshape(1) for name, value in scalars.items()}
    out[f"{prefix}.scale"] = model.scale.value.clone()


def terminated(model, config, batch, done, out):
    """Records the value loss of a batch with terminations: the reference's targets with the next value masked."""
    original = reference.two_hot_inv
    step = SimpleNamespace(call=0)
    # In every step, the reference decodes two values of the next frame (masked), then one value per Q function.
    per_step = 2 + config.wm.num_q

    def masked(logits, cfg):
        values = original(logits, cfg)
        call, step.call = step.call, step.call + 1
        if call % per_step < 2:
            values = values * (1 - done[:, call // per_step]).unsqueeze(1)
        return values

    reference.two_hot_inv = masked
    record(model, config, batch, out, "o.terminated")
    reference.two_hot_inv = original


def main(path):
    torch.manual_seed(0)
    random.seed(0)
    config = Config(CONFIG)
    model = reference.TDMPC2(config)
    # Initial values (zero output layers, unit scales, equal targets) could hide errors, so noise is added.
    with torch.no_grad():
        for value in model.state_dict().values():
            value.add_(0.2 * torch.randn_like(value))
    for module in model.modules():
        if isinstance(module, torch.nn.Dropout):
            module.p = 0.0
    model.train()

    steps = config.wm.horizon + 1
    batch = {
        "state": torch.randn(CLIPS, steps, 3),
        "speed": torch.randn(CLIPS, steps, 2),
        "action": torch.rand(CLIPS, steps, config.action_dim) * 2 - 1,
        "reward": torch.randn(CLIPS, steps) * 3,
    }
    done = (torch.rand(CLIPS, steps) < 0.3).float()
    out = {f"i.{name}": value for name, value in batch.items()} | {"i.terminated": done}
    out |= {f"w.{name}": value.clone() for name, value in model.state_dict().items()}
    scale = model.scale.value.clone()
    terminated(model, config, dict(batch), done, out)
    model.scale.value.data.copy_(scale)
    record(model, config, dict(batch), out, "o.train")
    out |= {f"g.{name}": value.grad for name, value in model.named_parameters() if value.grad is not None}

    header, data = {"__metadata__": {"config": json.dumps(CONFIG)}}, b""
    for name, value in sorted(out.items()):
        raw = value.detach().float().contiguous().numpy().tobytes()
        header[name] = {"dtype": "F32", "shape": list(value.shape), "data_offsets": [len(data), len(data) + len(raw)]}
        data += raw
    text = json.dumps(header).encode()
    with open(path, "wb") as file:
        file.write(struct.pack("<Q", len(text)) + text + data)


if __name__ == "__main__":
    main(sys.argv[1])
