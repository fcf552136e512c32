"""Tests of plans and trainings in PyTorch on an NVIDIA GPU; skipped without one."""

import json

import numpy as np
import pytest

import stable_worldmodel as swm

torch = pytest.importorskip("torch")
if not torch.cuda.is_available():
    pytest.skip("no NVIDIA GPU", allow_module_level=True)

from stable_worldmodel.planning.adapter import Adapter  # noqa: E402
from stable_worldmodel.planning.capture import CapturedCosts  # noqa: E402
from stable_worldmodel.train import Options, Trainer, train  # noqa: E402

SHORT = ["data.batch_size=16", "schedule.steps=8", "schedule.warmup=1", "shards=1", "log_every=2"]


@pytest.fixture(scope="module")
def world():
    return swm.World("swm/TwoRoom-v1", num_envs=3, image_shape=(64, 64), max_episode_steps=25)


@pytest.fixture(scope="module")
def rooms(world, tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "rooms.lance"
    world.collect(path, episodes=8, seed=0, progress=False, policy=swm.policy.RandomPolicy(seed=0))
    return str(path)


@pytest.fixture(scope="module")
def run(rooms, tmp_path_factory):
    out = tmp_path_factory.mktemp("run") / "lewm"
    train("lewm", rooms, out=str(out), preset="tiny", device="cpu", settings=[*SHORT, "model.predictor.history=3"])
    return str(out)


def infos_of(world, seed):
    world.reset(seed=seed)
    return {key: world.infos[key].copy() for key in ("pixels", "goal")}


def candidates_of(model, seed, samples=6):
    return np.random.default_rng(seed).normal(size=(3, samples, 5, 2 * model.action_block)).astype(np.float32)


def costs(model, infos, candidates, device="cuda"):
    adapter = Adapter(model, device, dim=candidates.shape[3])
    adapter.set_infos(infos)
    # The second call computes nothing but the candidates.
    adapter.cost(np.zeros_like(candidates))
    return adapter.cost(candidates)


def close(a, b, within=1e-5):
    return np.abs(a - b).max() <= within * np.abs(b).max()


def test_recorded_costs_are_those_of_the_cpu(run, world):
    model = swm.wm.LeWM.from_pretrained(run)
    cpu = {seed: costs(model, infos_of(world, seed), candidates_of(model, seed), "cpu") for seed in range(3)}
    model.to("cuda")
    for seed in (0, 1, 2, 0):
        assert close(costs(model, infos_of(world, seed), candidates_of(model, seed)), cpu[seed])
    recorded = CapturedCosts.of(model)
    assert len(recorded._graphs) == 1 and not recorded._refused


def test_recorded_costs_follow_changed_weights_and_shapes(run, world):
    model = swm.wm.LeWM.from_pretrained(run).to("cuda")
    infos = infos_of(world, 1)
    costs(model, infos, candidates_of(model, 1))
    with torch.no_grad():
        for parameter in model.predictor.parameters():
            parameter.mul_(1.1)
    changed = costs(model, infos, candidates_of(model, 1))
    assert close(changed, costs(model.to("cpu"), infos, candidates_of(model, 1), "cpu"))
    # New places of the weights, and more candidates, are other graphs.
    model.to("cuda")
    assert close(costs(model, infos, candidates_of(model, 1)), changed)
    assert costs(model, infos, candidates_of(model, 1, samples=9)).shape == (3, 9)


def test_costs_in_half_precision_and_compiled(run, world):
    model = swm.wm.LeWM.from_pretrained(run).to("cuda")
    infos, candidates = infos_of(world, 2), candidates_of(model, 2)
    single = costs(model, infos, candidates)
    with torch.autocast("cuda", torch.bfloat16):
        half = costs(model, infos, candidates)
    assert close(half, single, 0.1) and not np.array_equal(half, single)
    assert np.array_equal(costs(model, infos, candidates), single)
    model.compile(dynamic=False)
    assert close(costs(model, infos, candidates), single, 1e-4)


def test_a_cost_that_cannot_be_recorded_is_computed_with_a_warning(run, world):
    class Reads(swm.wm.LeWM):
        def criterion(self, info_dict, action_candidates=None):
            return super().criterion(info_dict) * (1 + 0 * action_candidates.sum().item())

    model = Reads.from_pretrained(run).to("cuda")
    with pytest.warns(UserWarning, match="cannot be recorded as a CUDA graph"):
        found = costs(model, infos_of(world, 3), candidates_of(model, 3))
    Reads.prepare_plan = None
    assert close(found, costs(model, infos_of(world, 3), candidates_of(model, 3)))


def test_plans_on_the_gpu_are_those_of_the_cpu(run, world):
    actions = {}
    for device in ("cpu", "cuda"):
        model = swm.wm.LeWM.from_pretrained(run).to(device)
        solver = swm.planning.CEMSolver(model, num_samples=32, n_steps=3, topk=4, device=device)
        config = swm.policy.PlanConfig(horizon=4, receding_horizon=1, action_block=model.action_block)
        world.reset(seed=4)
        world.set_policy(swm.policy.WorldModelPolicy(solver, config=config))
        actions[device] = np.stack([np.asarray(world.policy.get_action(world.infos)) for _ in range(3)])
    assert close(actions["cuda"], actions["cpu"], 1e-3)


@pytest.mark.parametrize("amp", ["off", "bf16", "fp16"])
@pytest.mark.parametrize("compile", [False, True])
def test_trainings_end_in_checkpoints_of_the_engine(rooms, world, tmp_path, amp, compile):
    given = {"preset": "tiny", "device": "cuda", "amp": amp, "compile": compile, "settings": SHORT}
    train("lewm", rooms, out=str(tmp_path / "run"), **given)
    rows = [json.loads(line) for line in (tmp_path / "run/train.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [2, 4, 6, 8]
    assert rows[-1]["prediction"] < rows[0]["prediction"]
    model = swm.wm.load(str(tmp_path / "run"))
    given = infos_of(world, 5)
    candidates = candidates_of(model, 5)
    assert np.isfinite(model.get_cost(given, candidates)).all()


def test_a_training_continues_on_the_gpu_as_it_was(rooms, tmp_path):
    def trainer(name, resume=False):
        given = {"out": str(tmp_path / name), "preset": "tiny", "device": "cuda", "resume": resume, "settings": SHORT}
        return Trainer(Options("lewm", rooms, **given))

    trainer("whole").train()
    trainer("parts").train(until=3)
    trainer("parts", resume=True).train()
    whole, parts = (swm.wm.LeWM.from_pretrained(str(tmp_path / name)).state_dict() for name in ("whole", "parts"))
    for name, value in whole.items():
        if value.is_floating_point():
            assert (parts[name] - value).abs().max() <= 1e-4 * value.abs().max() + 1e-7, name


def test_the_largest_batch_that_fits_is_found(world, tmp_path, capsys):
    data = str(tmp_path / "rooms.lance")
    world.collect(data, episodes=80, seed=1, progress=False, policy=swm.policy.RandomPolicy(seed=0))
    settings = [setting for setting in SHORT if "batch_size" not in setting]
    given = {"preset": "small", "device": "cuda"}
    # A small part of the memory, so that the dataset has enough clips.
    held = [torch.empty(torch.cuda.mem_get_info()[0] - (1 << 30), dtype=torch.uint8, device="cuda")]
    train("lewm", data, out=str(tmp_path / "auto"), settings=["data.batch_size=auto", *settings], **given)
    found = swm.wm.LeWM.from_pretrained(str(tmp_path / "auto")).stored.config["data"]["batch_size"]
    assert found >= 32 and found % 8 == 0 and f"{found} clips take" in capsys.readouterr().err
    torch.cuda.empty_cache()
    held.append(torch.empty(torch.cuda.mem_get_info()[0] - (1 << 27), dtype=torch.uint8, device="cuda"))
    with pytest.raises(RuntimeError, match="lower data.batch_size=400 and raise optim.accumulate"):
        train("lewm", data, out=str(tmp_path / "large"), settings=["data.batch_size=400", *settings], **given)
