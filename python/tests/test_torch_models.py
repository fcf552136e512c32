"""Tests that the torch modules of `stable_worldmodel.wm` compute what the published models compute.

The files beside the exporters in `crates/swm-models/tests/golden` hold weights, inputs, outputs and gradients of the
published models at small sizes; the engine's models are compared with the same files.
"""

import functools
import json
import os
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import stable_worldmodel as swm

torch = pytest.importorskip("torch")
torch.set_num_threads(1)

from torch import nn  # noqa: E402

from stable_worldmodel.wm import _weights  # noqa: E402
from stable_worldmodel.wm.encoders import ViT  # noqa: E402
from stable_worldmodel.wm.gcrl import module as gcrl  # noqa: E402
from stable_worldmodel.wm.lewm.module import MLP, Attention, Embedder, Predictor, Transformer  # noqa: E402
from stable_worldmodel.wm.lewm.rollout import rolls  # noqa: E402
from stable_worldmodel.wm.prejepa.module import CausalPredictor  # noqa: E402

GOLDEN = Path(__file__).parents[2] / "crates/swm-models/tests/golden"
#: Further recordings, of other sizes, if there are any.
MORE = Path(os.environ.get("SWM_GOLDEN_MODELS", Path(__file__).parents[3] / "shared/reference/models"))


def recorded(path):
    """The configuration and the tensors of a recording, by the letter before the dot."""
    data = path.read_bytes()
    header = json.loads(data[8 : 8 + struct.unpack("<Q", data[:8])[0]])
    parts = {"i": {}, "o": {}, "w": {}, "g": {}}
    for name, value in _weights.read_safetensors(path).items():
        kind, _, rest = name.partition(".")
        parts[kind][rest] = value
    return json.loads(header["__metadata__"]["config"]), parts


def files(pattern, more):
    return [GOLDEN / pattern, *([MORE / more] if (MORE / more).exists() else [])]


def near(actual, expected, tolerance=1e-5):
    """Whether all elements differ by at most a fraction of the largest expected element."""
    error = (actual.detach() - expected).abs().max() / expected.abs().max().clamp(min=1e-12)
    assert error < tolerance, f"differs by {float(error):.1e} of the largest element"


def load(module, weights):
    missing, unexpected = module.load_state_dict(weights, strict=False)
    assert not unexpected and all(name.endswith("num_batches_tracked") for name in missing), (missing, unexpected)
    return module.eval()


def jepa(kind, c, latent):
    encoder = ViT(c["image"], c["patch"], c["dim"], c["vit_layers"], c["vit_heads"], c["vit_mlp"])
    project = lambda inputs: MLP(inputs, c["proj_hidden"], latent, nn.BatchNorm1d)  # noqa: E731
    sizes = dict(num_frames=c["history"], depth=c["depth"], heads=c["heads"], mlp_dim=c["mlp"], dim_head=c["dim_head"])
    predictor = Predictor(**sizes, input_dim=latent, hidden_dim=c["dim"], output_dim=latent)
    action_encoder = Embedder(c["action_dim"], c["action_dim"], latent)
    return kind(encoder, predictor, action_encoder, project(c["dim"]), project(latent))


@pytest.mark.parametrize("path", files("lewm-small.safetensors", "lewm-0.safetensors"), ids=lambda path: path.stem)
def test_lewm_equals_the_published_model(path):
    c, parts = recorded(path)
    given, expected = parts["i"], parts["o"]
    model = load(jepa(swm.wm.LeWM, c, c["dim"]), parts["w"])
    with torch.no_grad():
        info = model.encode({"pixels": given["pixels"], "action": given["action"]})
        near(info["emb"], expected["eval.emb"])
        near(info["act_emb"], expected["eval.act_emb"])
        h = c["history"]
        near(model.predict(info["emb"][:, :h], info["act_emb"][:, :h]), expected["eval.pred"])
        envs, samples = given["candidates"].shape[:2]
        spread = lambda x: x[:, None].expand(-1, samples, *x.shape[1:])  # noqa: E731
        for history in (1, 3):
            past = spread(given["action"][:envs, : history - 1])
            pixels, goal = spread(given["pixels"][:envs, :history]), spread(given["goal"])
            # The actions between the frames, in the infos or at the beginning of the candidates.
            for infos, candidates in (
                ({"action_history": past}, given["candidates"]),
                ({}, torch.cat([past, given["candidates"]], 2)),
            ):
                infos |= {"pixels": pixels, "goal": goal}
                near(model.get_cost(infos, candidates), expected[f"cost.h{history}"])
                near(infos["predicted_emb"], expected[f"rollout.h{history}"])
    model.train()
    info = model.encode({"pixels": given["pixels"], "action": given["action"]})
    emb, act = info["emb"], info["act_emb"]
    error = (model.predict(emb[:, :h], act[:, :h]) - emb[:, 1 : h + 1]).square().mean()
    regulariser = swm.wm.SIGReg(c["knots"], 1).statistic(emb.transpose(0, 1), given["sigreg_projections"])
    loss = error + c["sigreg_weight"] * regulariser
    near(loss[None], expected["train.loss"])
    near(regulariser[None], expected["train.sigreg_loss"])
    loss.backward()
    largest = max(float(gradient.abs().max()) for gradient in parts["g"].values())
    for name, parameter in model.named_parameters():
        # Gradients that cancel out exactly are rounding errors, so they are compared with the largest one.
        wanted = parts["g"][name]
        assert (parameter.grad - wanted).abs().max() < 1e-4 * max(float(wanted.abs().max()), 0.1 * largest), name


def test_pldm_equals_the_published_model():
    c, parts = recorded(GOLDEN / "pldm-model-small.safetensors")
    given, expected = parts["i"], parts["o"]
    idm = MLP(2 * c["latent"], c["idm_hidden"], c["action_dim"])
    both = load(nn.ModuleDict({"model": jepa(swm.wm.PLDM, c, c["latent"]), "idm": idm}), parts["w"])
    model, h = both["model"], c["history"]
    with torch.no_grad():
        info = model.encode({"pixels": given["pixels"], "action": given["action"]})
        near(info["emb"], expected["eval.emb"])
        near(model.predict(info["emb"][:, :h], info["act_emb"][:, :h]), expected["eval.pred"])
        candidates = given["candidates"][None]
        spread = lambda x: x[:, None].expand(-1, candidates.shape[1], *x.shape[1:])  # noqa: E731
        infos = {"pixels": spread(given["pixels"][:1, :1]), "goal": spread(given["goal"][None])}
        if infos["goal"].ndim > infos["pixels"].ndim:
            infos["goal"] = spread(given["goal"])
        near(model.get_cost(infos, candidates), expected["cost"])
        near(infos["predicted_emb"][0], expected["rollout"])
    both.train()
    info = model.encode({"pixels": given["pixels"], "action": given["action"]})
    emb, act = info["emb"], info["act_emb"]
    losses = {"pred_loss": (model.predict(emb[:, :h], act[:, :h]) - emb[:, 1:]).square().mean()}
    losses |= swm.wm.PLDMLoss()(emb, idm(torch.cat([emb[:, 1:], emb[:, :-1]], -1)), given["action"][:, :-1])
    losses["temp_straight_loss"] = swm.wm.TemporalStraighteningLoss()(emb)
    for name, value in losses.items():
        near(value[None], expected[f"train.{name}"])
    loss = losses["pred_loss"] + sum(weight * losses[f"{name}_loss"] for name, weight in c["weights"].items())
    near(loss[None], expected["train.loss"])
    loss.backward()
    largest = max(float(gradient.abs().max()) for gradient in parts["g"].values())
    for name, parameter in both.named_parameters():
        wanted = parts["g"].get(name)
        if wanted is not None:
            assert (parameter.grad - wanted).abs().max() < 1e-4 * max(float(wanted.abs().max()), 0.1 * largest), name


class Still(swm.wm.LeWM):
    """A model whose latents never move."""

    def predict(self, emb, act_emb):
        return emb


class Doubled(Attention):
    def forward(self, x, causal=True):
        return 2 * super().forward(x, causal)


class Shifted(Transformer):
    def forward(self, x, c=None):
        return super().forward(x, c) + 1


class LowRank(nn.Linear):
    """A linear layer with an adapter, as LoRA has it."""

    def forward(self, x):
        return super().forward(x) + x.sum(-1, keepdim=True)


def of_kind(kind, *path):
    def change(model):
        part = model.get_submodule(".".join(path)) if path else model
        part.__class__ = kind

    return change


def biased(model):
    layer = model.predictor.transformer.layers[0].attn
    other = nn.Linear(layer.to_qkv.in_features, layer.to_qkv.out_features)
    other.weight, other.bias.data = layer.to_qkv.weight, torch.ones_like(other.bias)
    layer.to_qkv = other


ATTENTION = "predictor.transformer.layers.0.attn"
#: Changes of a model that its rollouts must follow, by what they change.
CHANGES = {
    "predict of a subclass": of_kind(Still),
    "predict of an object": lambda model: setattr(model, "predict", lambda emb, act_emb: emb * 2),
    "an attention": of_kind(Doubled, ATTENTION),
    "a transformer": of_kind(Shifted, "predictor.transformer"),
    "an adapter": of_kind(LowRank, ATTENTION, "to_qkv"),
    "a bias": biased,
    "a part that is left out": lambda model: model.predictor.transformer.layers[0].register_module("attn", nn.Identity()),
    "the forward pass of an object": lambda model: setattr(model.get_submodule(ATTENTION), "forward", torch.ones_like),
    "the dropout": lambda model: model.predictor.register_module("dropout", nn.Sigmoid()),
    "a hook": lambda model: model.get_submodule(ATTENTION).register_forward_hook(lambda part, given, output: output * 3),
}


@pytest.mark.parametrize("change", CHANGES)
def test_rollouts_and_costs_follow_changes_of_a_model(change):
    c, parts = recorded(GOLDEN / "lewm-small.safetensors")
    given = parts["i"]
    plain, model = (load(jepa(swm.wm.LeWM, c, c["dim"]), parts["w"]) for _ in range(2))
    CHANGES[change](model)
    model.eval()
    envs, samples, horizon, _ = given["candidates"].shape
    spread = lambda x: x[:, None].expand(-1, samples, *x.shape[1:])  # noqa: E731
    infos = {"pixels": spread(given["pixels"][:envs, :1]), "goal": spread(given["goal"])}
    with torch.no_grad():
        rolled, unchanged = dict(infos), dict(infos)
        costs = model.get_cost(rolled, given["candidates"])
        plain.get_cost(unchanged, given["candidates"])
        latents = [rolled["emb"][:, :, 0].flatten(0, 1)]
        actions = model.action_encoder(given["candidates"].flatten(0, 1))
        for now in range(1, horizon + 1):
            begin = max(0, now - c["history"])
            latents.append(model.predict(torch.stack(latents[begin:], 1), actions[:, begin:now])[:, -1])
    near(rolled["predicted_emb"].flatten(0, 1), torch.stack(latents, 1))
    goal = rolled["goal_emb"].reshape(costs.shape[0], -1, latents[-1].shape[-1])[:, -1:]
    near(costs, (latents[-1].unflatten(0, costs.shape) - goal).square().sum(-1))
    assert (rolled["predicted_emb"] - unchanged["predicted_emb"]).abs().max() > 0.01


def test_a_replaced_forward_pass_of_a_class_is_called_in_rollouts(monkeypatch):
    c, parts = recorded(GOLDEN / "lewm-small.safetensors")
    model = load(jepa(swm.wm.LeWM, c, c["dim"]), parts["w"])
    assert rolls(model.predictor)
    calls, forward = [], Attention.forward

    @functools.wraps(forward)
    def watched(self, x, causal=True):
        calls.append(x.shape)
        return forward(self, x, causal)

    monkeypatch.setattr(Attention, "forward", watched)
    candidates = parts["i"]["candidates"]
    spread = parts["i"]["pixels"][:1, None, :1].expand(-1, candidates.shape[1], *([-1] * 4))
    with torch.no_grad():
        model.rollout({"pixels": spread}, candidates[:1])
    assert len(calls) == candidates.shape[2] * c["depth"]
    # Dropout as an estimate of the uncertainty: of a part that trains on its own.
    model.predictor.dropout.train()
    assert not rolls(model.predictor)


def test_every_module_can_be_the_first_that_is_imported():
    program = """
import sys
import stable_worldmodel as swm
import torch
for name in [*swm.wm.__all__, *swm.wm._MODULES]:
    for loaded in [key for key in sys.modules if key.startswith("stable_worldmodel.wm")]:
        del sys.modules[loaded]
    vars(swm).pop("wm", None)
    getattr(swm.wm, name)
"""
    done = subprocess.run([sys.executable, "-P", "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(not (MORE / "pldm-losses-0.safetensors").exists(), reason="no recordings of other sizes")
def test_losses_equal_the_published_ones():
    _, parts = recorded(MORE / "pldm-losses-0.safetensors")
    z = parts["i"]["z"].requires_grad_()
    losses = swm.wm.PLDMLoss()(z, parts["i"]["a_pred"], parts["i"]["a_target"])
    for name, value in losses.items():
        near(value[None], parts["o"][name])
    straight = swm.wm.TemporalStraighteningLoss()(z)
    near(straight[None], parts["o"]["straightening"])


@pytest.mark.skipif(not (MORE / "gcrl-0.safetensors").exists(), reason="no recordings of other sizes")
def test_goal_conditioned_heads_equal_the_published_ones():
    c, parts = recorded(MORE / "gcrl-0.safetensors")
    given, expected = parts["i"], parts["o"]
    sizes = {key: c[key] for key in ("num_patches", "num_frames", "dim", "depth", "heads", "mlp_dim", "dim_head")}
    own = lambda name: {k.removeprefix(f"{name}."): v for k, v in parts["w"].items() if k.startswith(f"{name}.")}  # noqa: E731
    policy = load(gcrl.Predictor(**sizes, out_dim=c["out_dim"]), own("policy"))
    critic = load(gcrl.QPredictor(**sizes, action_dim=c["action_dim"], q_hidden_dim=c["q_hidden_dim"]), own("q"))
    near(policy(given["x"], given["goal"]), expected["policy"])
    near(critic(given["x"], given["action"], given["goal"]), expected["q"])
    for tau in (0.7, 0.9):
        near(gcrl.ExpectileLoss(tau)(given["preds"], given["targets"])[None], expected[f"expectile_{tau}"])


@pytest.mark.skipif(not (MORE / "dino-wm-predictor-0.safetensors").exists(), reason="no recordings of other sizes")
def test_the_predictor_of_dino_wm_equals_the_published_one():
    c, parts = recorded(MORE / "dino-wm-predictor-0.safetensors")
    predictor = load(CausalPredictor(**c), parts["w"])
    near(predictor(parts["i"]["x"]), parts["o"]["y"])
    frames = parts["o"]["y_two_frames"].shape[1]
    near(predictor(parts["i"]["x"][:, :frames]), parts["o"]["y_two_frames"])


@pytest.mark.skipif(not (MORE / "tdmpc2-0.safetensors").exists(), reason="no recordings of other sizes")
def test_tdmpc2_equals_the_published_model():
    from stable_worldmodel.wm import tdmpc2

    c, parts = recorded(MORE / "tdmpc2-0.safetensors")
    given, expected = parts["i"], parts["o"]
    model = load(swm.wm.TDMPC2(c), parts["w"])
    with torch.no_grad():
        z = model.encode({"state": given["state"]})
        near(z, expected["z"])
        action = given["candidates"][:, 0, 0]
        following, reward = model(z, action)
        near(following, expected["next_z"])
        near(reward, expected["reward_logits"])
        near(tdmpc2.two_hot_inv(reward, c), expected["reward"])
        near(model.pi(z), expected["pi"])
        near(torch.stack([q(torch.cat([z, action], -1)) for q in model.qs]), expected["q_logits"])
        samples = given["candidates"].shape[1]
        infos = {"state": given["state"][:, None].expand(-1, samples, -1)}
        near(model.get_cost(infos, given["candidates"]), expected["cost"])
        near(tdmpc2.module.symlog(given["values"]), expected["symlog"])
        near(tdmpc2.module.symexp(given["values"] / 5), expected["symexp"])
        near(tdmpc2.two_hot(given["values"], c), expected["two_hot"])


def test_a_training_step_of_tdmpc2_lowers_the_loss():
    torch.manual_seed(0)
    wm = {"encoding": {"state": 16}, "enc_dim": 16, "mlp_dim": 32, "num_bins": 21, "vmin": -10, "vmax": 10, "num_q": 3}
    wm |= {"horizon": 3, "rho": 0.5, "consistency_coef": 20, "reward_coef": 0.1, "value_coef": 0.1, "tau": 0.5}
    cfg = {"action_dim": 2, "extra_dims": {"state": 4}, "wm": wm}
    model, logs = swm.wm.TDMPC2(cfg), []

    class Step:
        def log_dict(self, values, **kwargs):
            logs.append({name: float(value.detach()) for name, value in values.items()})

    step = Step()
    step.model = model
    optimizer = torch.optim.Adam(model.parameters(), 3e-3)
    state, action = torch.randn(32, 4, 4), torch.rand(32, 4, 2) * 2 - 1
    batch = {"state": state, "action": action, "reward": state[..., 0] + action[..., 0]}
    before = [parameter.clone() for parameter in model.target_qs.parameters()]
    for _ in range(40):
        loss = swm.wm.tdmpc2_forward(step, dict(batch), "train", cfg)["loss"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    for name in ("consist", "reward", "value"):
        assert logs[-1][f"train/{name}"] < 0.95 * logs[0][f"train/{name}"], (name, logs[0], logs[-1])
    assert any(not torch.equal(old, new) for old, new in zip(before, model.target_qs.parameters(), strict=True))
    swm.wm.tdmpc2_forward(step, dict(batch), "validate", cfg)
    assert "validate/loss" in logs[-1]


def test_the_value_of_hilp_is_a_negative_distance():
    torch.manual_seed(0)
    sizes = dict(num_patches=2, num_frames=3, dim=8, depth=2, heads=2, mlp_dim=16, dim_head=4)
    value = gcrl.MetricValuePredictor(**sizes).eval()
    frames, goal = torch.randn(4, 6, 8), torch.randn(4, 2, 8)
    found = value(frames, goal)
    assert found.shape == (4, 3, 1) and (found < 0).all()
    points, target = value.encode(frames), value.encode(goal)
    near(found, -(points - target).norm(dim=-1, keepdim=True))
    # The first frame is a function of its own patches only, so its distance from itself is the smallest possible.
    assert torch.allclose(value(frames[:, :2], frames[:, :2]), torch.tensor(-1e-3))


class Patches(nn.Module):
    """An encoder whose tokens are the mean colours of the quarters of a frame, after one for the whole frame."""

    def forward(self, pixels, interpolate_pos_encoding=True):
        quarters = nn.functional.adaptive_avg_pool2d(pixels, 2).flatten(2).transpose(1, 2)
        hidden = torch.cat([quarters.mean(1, keepdim=True), quarters], 1)
        return type("Output", (), {"last_hidden_state": hidden})


def prejepa():
    from stable_worldmodel.wm.prejepa.module import Embedder

    torch.manual_seed(1)
    encoders = nn.ModuleDict({"proprio": Embedder(in_chans=3, emb_dim=2), "action": Embedder(in_chans=2, emb_dim=4)})
    predictor = CausalPredictor(num_patches=4, num_frames=2, dim=9, depth=1, heads=3, mlp_dim=16, dim_head=3)
    return swm.wm.PreJEPA(Patches(), predictor, encoders, history_size=2).eval()


def test_dino_wm_rolls_out_frames_and_replaces_actions():
    model, frame = prejepa(), torch.rand(2, 1, 3, 8, 8)
    spread = lambda x: x[:, None].expand(-1, 5, *x.shape[1:])  # noqa: E731
    goal_proprio = torch.randn(2, 1, 3)
    infos = {"pixels": spread(frame), "goal": spread(frame), "proprio": spread(torch.randn(2, 1, 3))}
    infos["goal_proprio"] = spread(goal_proprio)
    candidates = torch.randn(2, 5, 3, 2)
    cost = model.get_cost(infos, candidates)
    assert cost.shape == (2, 5) and infos["predicted_emb"].shape == (2, 5, 4, 4, 9)
    assert infos["predicted_pixels_emb"].shape == (2, 5, 4, 4, 3) and infos["predicted_proprio_emb"].shape == (2, 5, 4, 2)
    # By hand: each frame is predicted from the last two, whose actions are the candidates'.
    embedding = model.encode({"pixels": frame, "proprio": infos["proprio"][:, 0], "action": candidates[:, 2, :1]})["emb"]
    frames = embedding
    for step in range(1, 4):
        predicted = model.predict(frames[:, -2:])[:, -1:].clone()
        if step < 3:
            action = model.extra_encoders["action"](candidates[:, 2, step : step + 1])
            predicted[..., 5:] = action.unsqueeze(2)
        frames = torch.cat([frames, predicted], 1)
    near(infos["predicted_emb"][:, 2], frames)
    goal = model.encode({"pixels": frame, "proprio": goal_proprio}, emb_keys=["proprio"])
    last = (frames[:, -1, :, :3] - goal["pixels_emb"][:, -1]).square().mean((1, 2))
    last = last + (frames[:, -1, 0, 3:5] - goal["proprio_emb"][:, -1]).square().mean(1)
    near(cost[:, 2], last)


def test_goal_conditioned_policies_act():
    sizes = dict(num_patches=4, num_frames=3, dim=3, depth=2, heads=1, mlp_dim=8, dim_head=3)
    torch.manual_seed(2)
    model = swm.wm.GCRL(Patches(), gcrl.Predictor(**sizes, out_dim=2), gcrl.Predictor(**sizes, out_dim=1)).eval()
    infos = {"pixels": torch.rand(4, 1, 3, 8, 8), "goal": torch.rand(4, 1, 3, 8, 8)}
    action = model.get_action(infos)
    assert action.shape == (4, 2) and torch.equal(action, model.get_action(infos)) and set(infos) == {"pixels", "goal"}
    with torch.no_grad():
        model.log_stds.fill_(-9.0)
    draws = torch.stack([model.get_action(infos, sample=True, temperature=2.0) for _ in range(400)])
    # The logarithm of the standard deviation is at least -5.
    assert abs(float((draws - action).std()) - 2 * np.exp(-5)) < 0.1 * np.exp(-5)
    info = model.encode(dict(infos))
    info = model.encode(info, pixels_key="goal", target="goal_embed")
    assert model.predict_values(info["embed"], info["goal_embed"]).shape == (4, 1, 1)
    with pytest.raises(ValueError, match="embed"):
        model.encode(info)


def test_encoders_of_timm_say_what_to_install(monkeypatch):
    from stable_worldmodel.wm.prejepa.module import create_backbone

    monkeypatch.setitem(sys.modules, "timm", None)
    with pytest.raises(ModuleNotFoundError, match="timm/vit_tiny_patch16_224.*pip install timm"):
        create_backbone("timm/vit_tiny_patch16_224")
