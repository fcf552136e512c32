"""Tests that a torch model and a Burn model with the same weights give the same plan for the same seed.

The engine trains the Burn model, a small LeWM. The torch model loads the same weights under their published names and
implements LeWM as the engine documents it. The two models sum in different orders, so their costs differ only in the last
bits of single precision.
"""

import json
import struct
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import stable_worldmodel as swm

torch = pytest.importorskip("torch")

from torch import nn  # noqa: E402

torch.set_num_threads(1)


class Pyramid(nn.Module):
    """Convolutions of disjoint patches, then two linear layers."""

    def __init__(self, stages, side, hidden, dim):
        super().__init__()
        first, *later = stages
        self.patches = [stage["patch"] for stage in later]
        self.stem = nn.Conv2d(3, first["channels"], first["patch"], first["patch"])
        inputs, side, self.stages = first["channels"], side // first["patch"], nn.ModuleList()
        for stage in later:
            self.stages.append(nn.Linear(stage["patch"] ** 2 * inputs, stage["channels"]))
            inputs, side = stage["channels"], side // stage["patch"]
        self.hidden, self.out = nn.Linear(side**2 * inputs, hidden), nn.Linear(hidden, dim)

    def forward(self, frames):
        x = self.stem(frames).relu().movedim(1, -1)
        for layer, patch in zip(self.stages, self.patches, strict=True):
            n, side, _, channels = x.shape
            blocks = x.reshape(n, side // patch, patch, side // patch, patch * channels).transpose(2, 3)
            x = layer(blocks.reshape(n, side // patch, side // patch, -1)).relu()
        return self.out(self.hidden(x.flatten(1)).relu())


class Projector(nn.Module):
    def __init__(self, inputs, hidden, outputs):
        super().__init__()
        self.net = nn.Sequential(nn.Linear(inputs, hidden), nn.BatchNorm1d(hidden), nn.GELU(), nn.Linear(hidden, outputs))

    def forward(self, x):
        return self.net(x)


class ActionEncoder(nn.Module):
    def __init__(self, actions, outputs):
        super().__init__()
        self.patch_embed = nn.Conv1d(actions, actions, 1)
        self.embed = nn.Sequential(nn.Linear(actions, 4 * outputs), nn.SiLU(), nn.Linear(4 * outputs, outputs))

    def forward(self, actions):
        return self.embed(self.patch_embed(actions[:, :, None])[:, :, 0])


class Attention(nn.Module):
    def __init__(self, dim, inner):
        super().__init__()
        self.norm, self.to_qkv = nn.LayerNorm(dim), nn.Linear(dim, 3 * inner, bias=False)
        self.to_out = nn.Sequential(nn.Linear(inner, dim))

    def forward(self, x):
        # With a history of 1, a token attends only to itself, so the result is its value.
        return self.to_out(self.to_qkv(self.norm(x)).chunk(3, -1)[2])


class FeedForward(nn.Module):
    def __init__(self, dim, hidden):
        super().__init__()
        self.net = nn.Sequential(nn.LayerNorm(dim), nn.Linear(dim, hidden), nn.GELU(), nn.Identity(), nn.Linear(hidden, dim))

    def forward(self, x):
        return self.net(x)


class Block(nn.Module):
    def __init__(self, dim, inner, hidden):
        super().__init__()
        self.attn, self.mlp = Attention(dim, inner), FeedForward(dim, hidden)
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(dim, 6 * dim))

    def forward(self, x, condition):
        parts = self.adaLN_modulation(condition).chunk(6, -1)
        for layer, (shift, scale, gate) in ((self.attn, parts[:3]), (self.mlp, parts[3:])):
            x = x + gate * layer(nn.functional.layer_norm(x, x.shape[-1:], eps=1e-6) * (1 + scale) + shift)
        return x


class Transformer(nn.Module):
    def __init__(self, latent, dim, inner, hidden, depth):
        super().__init__()
        self.norm = nn.LayerNorm(dim)
        self.input_proj, self.cond_proj = nn.Linear(latent, dim), nn.Linear(latent, dim)
        self.output_proj = nn.Linear(dim, latent)
        self.layers = nn.ModuleList(Block(dim, inner, hidden) for _ in range(depth))

    def forward(self, x, actions):
        x, condition = self.input_proj(x), self.cond_proj(actions)
        for layer in self.layers:
            x = layer(x, condition)
        return self.output_proj(self.norm(x))


class Predictor(nn.Module):
    def __init__(self, latent, **sizes):
        super().__init__()
        self.pos_embedding = nn.Parameter(torch.empty(1, 1, latent))
        self.transformer = Transformer(latent, **sizes)

    def forward(self, latents, actions):
        return self.transformer(latents + self.pos_embedding[:, 0], actions)


class TorchLewm(nn.Module):
    """A LeWM of history 1: a `Costable`, and a `Dynamics`."""

    def __init__(self, model, actions):
        super().__init__()
        pyramid, sizes, latent = model["encoder"]["pyramid"], model["predictor"], model["latent"]
        self.latent_dim = latent
        self.mean, self.std = (torch.tensor(model[name]).view(3, 1, 1) for name in ("pixel_mean", "pixel_std"))
        self.encoder = Pyramid(pyramid["stages"], model["image"], pyramid["hidden"], pyramid["dim"])
        self.projector = Projector(pyramid["dim"], model["projector"], latent)
        self.action_encoder = ActionEncoder(actions, latent)
        inner = sizes["heads"] * sizes["dim_head"]
        self.predictor = Predictor(latent, dim=sizes["dim"], inner=inner, hidden=sizes["mlp"], depth=sizes["depth"])
        self.pred_proj = Projector(latent, model["projector"], latent)

    def latents(self, frames):
        return self.projector(self.encoder((frames.movedim(-1, 1) / 255 - self.mean) / self.std))

    def encode(self, info_dict):
        return self.latents(info_dict["pixels"][:, -1])

    def encode_goal(self, info_dict):
        return self.latents(info_dict["goal"][:, -1])

    def predict(self, latents, actions):
        return self.pred_proj(self.predictor(latents, self.action_encoder(actions)))

    def get_cost(self, info_dict, action_candidates):
        if "latents" not in info_dict:
            # Infos are the same for every candidate.
            now = {key: info_dict[key][:, 0] for key in ("pixels", "goal")}
            info_dict["latents"] = self.encode(now).detach(), self.encode_goal(now).detach()
        start, goal = info_dict["latents"]
        envs, samples, horizon, _ = action_candidates.shape
        reached = start.repeat_interleave(samples, 0)
        for step in range(horizon):
            reached = self.predict(reached, action_candidates[:, :, step].flatten(0, 1))
        return ((reached.view(envs, samples, -1) - goal[:, None]) ** 2).sum(-1)


def tensors(path):
    """The tensors of a safetensors file, by name."""
    data = Path(path).read_bytes()
    (length,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + length])
    header.pop("__metadata__", None)
    found = {}
    for name, entry in header.items():
        assert entry["dtype"] == "F32"
        begin, end = (8 + length + at for at in entry["data_offsets"])
        found[name] = torch.from_numpy(np.frombuffer(data[begin:end], np.float32).copy().reshape(entry["shape"]))
    return found


def rooms(**more):
    return swm.World("swm/TwoRoom-v1", **{"num_envs": 3, "image_shape": (64, 64), "max_episode_steps": 25, **more})


@pytest.fixture(scope="module")
def twins(tmp_path_factory):
    """The engine's model and the torch model."""
    folder = tmp_path_factory.mktemp("twin")
    world = rooms()
    world.set_policy(swm.policy.RandomPolicy(seed=0))
    world.collect(folder / "rooms.lance", episodes=12, seed=0, progress=False)
    swm.wm.train(
        "lewm",
        data=str(folder / "rooms.lance"),
        out=str(folder / "lewm"),
        preset="tiny",
        data__batch_size=16,
        optim__lr=5e-3,
        schedule__steps=40,
        schedule__warmup=1,
        shards=1,
    )
    burn = swm.wm.load(str(folder / "lewm"))
    model, actions = burn.card["config"]["model"], len(burn.card["action_mean"]) * burn.action_block
    twin = TorchLewm(model, actions)
    missing, unexpected = twin.load_state_dict(tensors(folder / "lewm/checkpoint/weights.safetensors"), strict=False)
    assert not unexpected and all(name.endswith("num_batches_tracked") for name in missing)
    return burn, twin.eval()


@pytest.fixture(scope="module")
def infos():
    world = rooms()
    world.reset(seed=9)
    return {key: world.infos[key].copy() for key in ("pixels", "goal", "state")}


def in_model_units(card):
    """The action space of the world in the models' units."""
    mean, std = (np.asarray(card[name], np.float32) for name in ("action_mean", "action_std"))
    return gymnasium.spaces.Box((-1 - mean) / std, (1 - mean) / std, dtype=np.float32)


def test_torch_and_burn_costs_are_equal(twins, infos):
    burn, twin = twins
    draw = np.random.default_rng(0)
    candidates = draw.normal(size=(3, 20, 4, 10)).astype(np.float32)
    expected = burn.get_cost(infos, candidates)
    with torch.inference_mode():
        repeated = {key: torch.from_numpy(value)[:, None].expand(-1, 20, *value.shape[1:]) for key, value in infos.items()}
        cost = twin.get_cost(repeated, torch.from_numpy(candidates)).numpy()
    assert np.allclose(cost, expected, rtol=1e-4, atol=1e-5 * expected.max())
    # The comparison is not trivial: the costs of candidates differ.
    assert expected.std(1).min() > 1e-3 * expected.mean()


#: The maximum difference of plans, relative to their largest element; measured differences are a few millionths, and once
#: 1.2e-4 (GRASP). Searches run few iterations, because they amplify rounding errors: with two samples of nearly equal
#: cost, CEM may choose different elites, and the first steps of Adam follow the signs of gradients, even of tiny ones.
TOLERANCE = 5e-4

SOLVERS = [
    (swm.solver.CEMSolver, {"num_samples": 64, "n_steps": 4, "topk": 8}),
    (swm.solver.MPPISolver, {"num_samples": 64, "n_steps": 4, "topk": 64}),
    (swm.solver.GradientSolver, {"num_samples": 4, "n_steps": 8}),
    (swm.solver.GRASPSolver, {"n_steps": 12, "sync_every": 6, "sync_iterations": 3}),
]


@pytest.mark.parametrize(("solver", "settings"), SOLVERS, ids=[solver.id for solver, _ in SOLVERS])
def test_torch_and_burn_plans_are_equal(twins, infos, solver, settings):
    burn, twin = twins
    config = swm.PlanConfig(horizon=4, receding_horizon=4, action_block=burn.action_block)
    plans = []
    for model in twins:
        space = in_model_units(burn.card) if model is twin else gymnasium.spaces.Box(-1, 1, (2,), np.float32)
        planner = solver(model, seed=5, **settings)
        planner.configure(action_space=space, n_envs=3, config=config)
        plans.append(planner.solve(infos))
    burn_plan, torch_plan = (plan["actions"].numpy() for plan in plans)
    assert burn_plan.shape == (3, 4, 10)
    assert np.abs(burn_plan - torch_plan).max() < TOLERANCE * np.abs(burn_plan).max()
    assert np.allclose(plans[0]["costs"], plans[1]["costs"], rtol=1e-4)
    # The comparison is not trivial: plans differ between environments and between seeds.
    other = solver(burn, seed=6, **settings)
    other.configure(action_space=gymnasium.spaces.Box(-1, 1, (2,), np.float32), n_envs=3, config=config)
    assert np.abs(other.solve(infos)["actions"].numpy() - burn_plan).max() > 10 * TOLERANCE * np.abs(burn_plan).max()
    assert np.abs(burn_plan[0] - burn_plan[1]).max() > 10 * TOLERANCE * np.abs(burn_plan).max()


def test_torch_and_burn_policies_act_equally(twins):
    burn, twin = twins
    scaler = swm.data.ZScoreScaler(burn.card["action_mean"], burn.card["action_std"])
    config = swm.PlanConfig(horizon=3, receding_horizon=2, action_block=burn.action_block)
    settings = {"num_samples": 32, "n_steps": 2, "topk": 8}
    played = []
    for policy in (
        swm.policy.MPCPolicy(swm.solver.CEMSolver(burn, **settings), config=config),
        swm.policy.MPCPolicy(swm.solver.CEMSolver(twin, **settings), config=config, process={"action": scaler}),
    ):
        world = rooms(num_envs=2)
        world.set_policy(policy)
        world.reset(seed=2)
        actions = []
        for _ in range(12):
            world.step()
            actions.append(world.infos["action"].copy())
        played.append(np.array(actions))
    assert np.allclose(*played, atol=1e-4) and played[0].std() > 0.1


def test_engine_model_accepts_numpy_and_torch(twins, infos):
    burn, _ = twins
    candidates = np.random.default_rng(1).normal(size=(3, 1, 2, 10)).astype(np.float32)
    expected = burn.get_cost(infos, candidates)
    assert isinstance(expected, np.ndarray) and expected.shape == (3, 1)
    tensor = torch.from_numpy(candidates).double()
    for samples in (1, 4):
        repeated = {key: torch.from_numpy(value)[:, None].expand(-1, samples, *value.shape[1:]) for key, value in infos.items()}
        cost = burn.get_cost(repeated, tensor.expand(-1, samples, -1, -1))
        assert torch.is_tensor(cost) and np.array_equal(cost.numpy(), np.repeat(expected, samples, 1))
    # Infos of several steps (as many as candidates), of which the last step counts.
    steps = {key: np.concatenate([np.zeros_like(value), value], 1) for key, value in infos.items()}
    assert np.array_equal(burn.get_cost(steps, np.repeat(candidates, 2, 1)), np.repeat(expected, 2, 1))


def test_engine_model_refuses_candidates_that_do_not_fit_the_infos(twins, infos):
    burn, _ = twins
    for shape in ((0, 4, 2, 10), (3, 0, 2, 10), (3, 4, 0, 10), (3, 4, 2, 0)):
        with pytest.raises(ValueError, match=r"action_candidates: .*each at least 1"):
            burn.get_cost(infos, np.zeros(shape, np.float32))
    for envs in (1, 2, 4):
        with pytest.raises(ValueError, match=rf"info_dict\['pixels'\]: got 3 rows, expected {envs}"):
            burn.get_cost(infos, np.zeros((envs, 4, 2, 10), np.float32))


def test_engine_model_reports_wrong_inputs(twins, infos):
    burn, _ = twins
    with pytest.raises(ValueError, match=r"\(B, S, H, A\)"):
        burn.get_cost(infos, np.zeros((3, 4, 10), np.float32))
    with pytest.raises(ValueError, match="10 action elements a model step"):
        burn.get_cost(infos, np.zeros((3, 4, 2, 4), np.float32))
    with pytest.raises(ValueError, match="goal"):
        burn.get_cost({"pixels": infos["pixels"]}, np.zeros((3, 4, 2, 10), np.float32))
    with pytest.raises(ValueError, match="trained with 5"):
        swm.policy.MPCPolicy(swm.solver.CEMSolver(burn), config=swm.PlanConfig())
    assert swm.policy.MPCPolicy(swm.solver.CEMSolver(burn)).config.action_block == 5
    with pytest.raises(ValueError, match="64"):
        rooms(image_shape=(32, 32)).evaluate(policy=swm.policy.MPCPolicy(swm.solver.CEMSolver(burn)), episodes=1, seed=0)
    with pytest.raises(ValueError, match="does not act"):
        rooms().evaluate(policy=swm.policy.FeedForwardPolicy(burn), episodes=1, seed=0)
    with pytest.raises(FileNotFoundError, match="nothing"):
        swm.wm.load("nothing")
