"""Tests of training in torch: it computes what the engine's training computes, on any number of processes."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import stable_worldmodel as swm

torch = pytest.importorskip("torch")
torch.set_num_threads(1)

from stable_worldmodel.train import Options, Trainer, parsed, train  # noqa: E402
from stable_worldmodel.train.losses import losses_of  # noqa: E402
from stable_worldmodel.train.ranks import Ranks  # noqa: E402
from stable_worldmodel.wm._weights import read_safetensors  # noqa: E402
from stable_worldmodel.wm.utils import load_pretrained  # noqa: E402

#: A training of seconds. A large epsilon, because AdamW turns rounding errors of tiny gradients into steps.
SHORT = [
    "data.batch_size=10",
    "schedule.steps=6",
    "schedule.warmup=2",
    "optim.epsilon=1e-2",
    "log_every=2",
    "shards=1",
]
PIXELS = 'model.encoding=[{column="pixels",latent=16},{column="state",latent=8}]'
#: The colours are found in the data.
COLOURS = "model.encoder={keypoints={filters=[],find_colours=3,sharpness=2.0,hidden=[12],dim=10}}"
CONV = "model.encoder={conv={channels=[6,8],hidden=12,dim=10}}"


@pytest.fixture(scope="module")
def swings(tmp_path_factory):
    """Episodes with rewards."""
    path = tmp_path_factory.mktemp("data") / "swings.lance"
    world = swm.World("swm/PendulumControl-v1", num_envs=3, image_shape=(64, 64), max_episode_steps=25)
    world.collect(path, episodes=12, seed=0, progress=False, policy=swm.policy.RandomPolicy(seed=0))
    return str(path)


def engine_train(family, rooms, out, settings, *flags):
    arguments = ["swm", "train", family, "--data", rooms, "--output", str(out), "--preset", "tiny", *flags, *settings]
    swm.wm.engine._command(arguments)


def torch_train(family, rooms, out, settings, **options):
    return train(family, rooms, settings=[*settings], out=str(out), preset="tiny", device="cpu", **options)


def weights(run, name="weights"):
    return read_safetensors(Path(run) / f"checkpoint/{name}.safetensors")


def distance(found, expected):
    return sum((found[name] - value).square().sum().item() for name, value in expected.items()) ** 0.5


def log_of(run):
    return [json.loads(line) for line in (Path(run) / "train.jsonl").read_text().splitlines()]


RUNS = [
    # The random directions of SIGReg are drawn differently.
    ("lewm", ["loss.weight=0.0"]),
    ("lewm", ["loss.weight=0.0", "loss.temp_straight=0.5", "data.num_steps=4"]),
    ("pldm", [CONV, "model.predictor.history=2", "optim.ema=0.5"]),
    ("pldm", ["loss.std_t=1.0", "loss.cov_t=1.0", "loss.temp_straight=0.5"]),
    ("pldm", [COLOURS]),
    ("gcbc", ["validation.every=3", "validation.batches=2"]),
    ("gcbc", [CONV, "optim.accumulate=2"]),
    ("gcivl", []),
    ("gcivl", ["model.metric=6", "model.head.depth=4", "model.history=2", "data.num_steps=3"]),
    ("gcivl", [CONV, "model.history=2", "data.num_steps=3"]),
    ("gciql", []),
    ("dino_wm", ["validation.every=3", "validation.batches=2"]),
    ("dino_wm", [CONV, "model.predictor.history=2", "optim.accumulate=2"]),
    ("dino_wm", ["model.decoder=8", 'model.columns=[{name="proprio",dim=3},{name="action",dim=4}]', "optim.ema=0.5"]),
    # The noise of the policy's actions is drawn differently.
    ("tdmpc2", ["loss.entropy=0.0", "optim.accumulate=2"]),
    ("tdmpc2", ["loss.entropy=0.0", "model.termination=true", "optim.ema=0.5"]),
    ("tdmpc2", ["loss.entropy=0.0", PIXELS, "model.image=64", "model.critics=2"]),
]
#: What a log has of other random numbers.
DRAWN = {"lewm": {"sigreg"}, "tdmpc2": {"entropy", "policy", "q"}}


def assert_close(found, expected, tolerance, scale=None):
    """Asserts that tensors differ by at most this share of their largest value, or of the largest value of all."""
    assert found.keys() == expected.keys()
    largest = scale or max(value.abs().max() for value in expected.values())
    for name, value in expected.items():
        assert (found[name] - value).abs().max() <= tolerance * largest, name


def part(tensors, prefix):
    return {name: value for name, value in tensors.items() if name.startswith(prefix)}


@pytest.mark.parametrize(("family", "settings"), RUNS)
def test_a_step_equals_that_of_the_engine(family, settings, rooms, swings, tmp_path):
    data = swings if family == "tdmpc2" else rooms
    short = [setting for setting in SHORT if not setting.startswith("schedule")]
    settings = [*short, *settings, "schedule.steps=1", "schedule.warmup=0"]
    engine_train(family, data, tmp_path / "engine", settings)
    torch_train(family, data, tmp_path / "torch", settings)
    expected, found = weights(tmp_path / "engine", "optimizer"), weights(tmp_path / "torch", "optimizer")
    # The first moment is a tenth of the clipped gradient. A rounding error may switch a ReLU of the convolutions.
    assert_close(part(found, "first."), part(expected, "first."), 5e-3)
    assert_close(part(found, "second."), part(expected, "second."), 5e-3)
    expected, found = weights(tmp_path / "engine"), weights(tmp_path / "torch")
    assert found.keys() == expected.keys()
    # torch adds up the statistics of channels-last maps in single precision, one value after the other.
    for name, value in expected.items():
        assert (found[name] - value).abs().max() <= 1e-3 * value.abs().max() + 1e-5, name


@pytest.mark.parametrize(("family", "settings"), RUNS)
def test_a_training_equals_that_of_the_engine(family, settings, rooms, swings, tmp_path):
    data = swings if family == "tdmpc2" else rooms
    settings = [*SHORT, *settings]
    engine_train(family, data, tmp_path / "engine", settings)
    torch_train(family, data, tmp_path / "torch", settings)
    for mine, theirs in zip(log_of(tmp_path / "torch"), log_of(tmp_path / "engine"), strict=True):
        for name in theirs.keys() - {"seconds", "clips_per_second", "data_wait"} - DRAWN.get(family, set()):
            assert mine[name] == pytest.approx(theirs[name], rel=0.05, abs=1e-5), name
    state = [json.loads((tmp_path / run / "checkpoint/state.json").read_text()) for run in ("torch", "engine")]
    assert state[0]["step"] == state[1]["step"] == 6
    manifests = [json.loads((tmp_path / run / "checkpoint/manifest.json").read_text()) for run in ("torch", "engine")]
    assert manifests[0]["config"] == manifests[1]["config"] and manifests[0]["hashes"].keys() == manifests[1]["hashes"].keys()
    assert swm.wm.load(str(tmp_path / "torch")).card["family"] == family


@pytest.mark.parametrize("family", ["lewm", "pldm", "gciql", "dino_wm", "tdmpc2"])
def test_float64_columns_train_as_their_float32_values(family, rooms, swings, tmp_path):
    narrow, wide = swings if family == "tdmpc2" else rooms, str(tmp_path / "wide.lance")
    dataset = swm.data.load_dataset(narrow)
    names = ["pixels", "action", "state", "reward", "terminated"]
    with swm.data.open_writer(wide) as writer:
        for number in range(len(dataset.lengths)):
            content = {name: np.asarray(values) for name, values in dataset.load_episode(number).items() if name in names}
            floats = {name: values.astype(np.float64) for name, values in content.items() if values.dtype == np.float32}
            assert "action" in floats
            writer.write_episode({**content, **floats})
    for name, data in [("narrow", narrow), ("wide", wide)]:
        torch_train(family, data, tmp_path / name, SHORT)
    assert_close(weights(tmp_path / "wide"), weights(tmp_path / "narrow"), 1e-6)


@pytest.mark.parametrize(("steps", "entropy"), [(40, 0.0), (1, 1.0)])
def test_the_policy_of_tdmpc2_gets_the_engines_gradient(steps, entropy, swings, tmp_path):
    # The noise of actions is drawn differently: values depend little on it, and so do entropies of a new policy.
    settings = ["data.batch_size=256", "model.critics=2", "optim.lr=5e-3", "optim.epsilon=1e-2", "loss.value=10.0"]
    settings += [f"schedule.steps={steps + 1}", f"loss.entropy={entropy}"]
    options = {"data": swings, "preset": "tiny", "device": "cpu", "settings": settings}
    Trainer(Options("tdmpc2", out=str(tmp_path / "engine"), **options)).train(until=steps)
    shutil.copytree(tmp_path / "engine", tmp_path / "torch")
    before = weights(tmp_path / "torch", "optimizer")
    engine_train("tdmpc2", swings, tmp_path / "engine", settings, "--resume")
    Trainer(Options("tdmpc2", out=str(tmp_path / "torch"), resume=True, **options)).train()
    runs = (weights(tmp_path / run, "optimizer") for run in ("engine", "torch"))
    expected, found = ({name: run[name] - 0.9 * value for name, value in before.items()} for run in runs)
    for prefix, tolerance in (("first.pi.", 0.1), ("first.qs.", 0.01), ("first.dynamics.", 0.01)):
        expected_part, found_part = part(expected, prefix), part(found, prefix)
        norm = sum(value.square().sum().item() for value in expected_part.values()) ** 0.5
        assert 0 < distance(found_part, expected_part) < tolerance * norm, prefix


@pytest.mark.parametrize("family", ["pldm", "gciql", "dino_wm", "tdmpc2"])
def test_engine_and_torch_continue_each_others_trainings(family, rooms, swings, tmp_path):
    data = swings if family == "tdmpc2" else rooms
    settings = [*SHORT, "optim.ema=0.5"]
    engine_train(family, data, tmp_path / "whole", settings)
    options = {"data": data, "preset": "tiny", "settings": settings, "device": "cpu"}
    Trainer(Options(family, out=str(tmp_path / "run"), **options)).train(until=3)
    engine_train(family, data, tmp_path / "run", settings, "--resume")
    Trainer(Options(family, out=str(tmp_path / "start"), **options)).train(until=3)
    for name in ("weights", "raw"):
        found, expected = weights(tmp_path / "run", name), weights(tmp_path / "whole", name)
        assert distance(found, expected) < 0.02 * distance(weights(tmp_path / "start", name), expected)
    with pytest.raises(ValueError, match="holds a training run"):
        Trainer(Options(family, out=str(tmp_path / "run"), **options))


@pytest.mark.parametrize("first", ["engine", "torch"])
def test_a_finished_training_of_the_other_program_is_left_as_it_is(first, rooms, tmp_path):
    settings = ["schedule.steps=2", "data.batch_size=8"]
    trainings = {"engine": engine_train, "torch": torch_train}
    trainings[first]("gcbc", rooms, tmp_path / "run", settings)
    files = [path for path in sorted((tmp_path / "run").rglob("*")) if path.is_file()]
    before = [path.read_bytes() for path in files]
    (second,) = set(trainings) - {first}
    with pytest.raises(ValueError, match="finished run of") as error:
        if second == "torch":
            torch_train("gcbc", rooms, tmp_path / "run", settings, resume=True)
        else:
            engine_train("gcbc", rooms, tmp_path / "run", settings, "--resume")
    assert "2 of 2 steps" in str(error.value)
    assert [path.read_bytes() for path in files] == before


def test_the_program_continues_a_run_without_its_model_and_dataset(rooms, tmp_path, monkeypatch):
    given = ["gcbc", f"data={os.path.relpath(rooms, tmp_path)}", "out=./run", "preset=tiny", "device=cpu", *SHORT]
    monkeypatch.chdir(tmp_path)
    Trainer(parsed(given[0], given[1:])).train(until=3)
    shutil.copytree("run", "named")
    engine_train("gcbc", rooms, tmp_path / "named", SHORT, "--resume")
    # The dataset is found from another folder as well, whose name it was given in.
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    swm.wm.engine._command(["swm", "train", "--output", str(tmp_path / "run"), "--resume"])
    found, expected = weights(tmp_path / "run"), weights(tmp_path / "named")
    assert all(torch.equal(found[name], value) for name, value in expected.items()) and found.keys() == expected.keys()
    assert [row["step"] for row in log_of(tmp_path / "run")][-1] == 6
    first, second = json.loads((tmp_path / "run/run.json").read_text())["commands"]
    assert first["command"][:3] == ["swm", "train", "gcbc"] and first["program"] == "stable_worldmodel.train (torch)"
    assert second["command"] == ["swm", "train", "--output", str(tmp_path / "run"), "--resume"] and "program" not in second
    # What other tests read from a hub is recorded, because this process did.
    assert first.keys() - {"program", "hub"} == second.keys() and first["folder"] == str(tmp_path)


def test_a_file_of_the_user_in_place_of_the_record_is_kept(rooms, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run/run.json").write_text('{"mine": 1}')
    with pytest.raises(ValueError, match="run.json.*not written by this program"):
        torch_train("gcbc", rooms, tmp_path / "run", SHORT)
    assert (tmp_path / "run/run.json").read_text() == '{"mine": 1}' and len(list((tmp_path / "run").iterdir())) == 1


@pytest.mark.parametrize(
    ("family", "dropout"), [("lewm", "model.predictor"), ("dino_wm", "model.predictor"), ("tdmpc2", "model")]
)
def test_a_continued_training_equals_a_whole_one(family, dropout, rooms, swings, tmp_path):
    data = swings if family == "tdmpc2" else rooms
    settings = [*SHORT, f"{dropout}.dropout=0.2", "optim.ema=0.9"]
    torch_train(family, data, tmp_path / "whole", settings)
    options = {"data": data, "preset": "tiny", "settings": settings, "device": "cpu", "out": str(tmp_path / "run")}
    Trainer(Options(family, **options)).train(until=4)
    Trainer(Options(family, resume=True, **options)).train()
    for name in ("weights", "raw", "optimizer"):
        found, expected = weights(tmp_path / "run", name), weights(tmp_path / "whole", name)
        assert all(torch.equal(found[key], value) for key, value in expected.items()) and found.keys() == expected.keys()
    assert [row["step"] for row in log_of(tmp_path / "run")] == [2, 4, 6]
    with pytest.raises(ValueError, match="stored 10, requested 11"):
        settings[0] = "data.batch_size=11"
        Trainer(Options(family, resume=True, **options))


def test_a_continued_training_in_half_precision_equals_a_whole_one(rooms, tmp_path):
    options = {"data": rooms, "preset": "tiny", "settings": SHORT, "device": "cpu", "amp": "fp16"}
    whole = Trainer(Options("gcivl", out=str(tmp_path / "whole"), **options))
    whole.train()
    # The first steps are left out, because the scale of the loss is too large.
    assert whole.scaler.get_scale() < 65536
    Trainer(Options("gcivl", out=str(tmp_path / "run"), **options)).train(until=4)
    shutil.copytree(tmp_path / "run", tmp_path / "single")
    continued = Trainer(Options("gcivl", out=str(tmp_path / "run"), resume=True, **options))
    continued.train()
    assert continued.scaler.state_dict() == whole.scaler.state_dict()
    for name in ("weights", "optimizer"):
        found, expected = weights(tmp_path / "run", name), weights(tmp_path / "whole", name)
        assert all(torch.equal(found[key], value) for key, value in expected.items()) and found.keys() == expected.keys()
    # In single precision, the run continues in both programs.
    shutil.copytree(tmp_path / "single", tmp_path / "engine")
    made = {float(state["step"]) for state in whole.optimizer.adam.state.values()}
    single = Trainer(Options("gcivl", out=str(tmp_path / "single"), resume=True, **{**options, "amp": "off"}))
    single.train()
    assert {float(state["step"]) for state in single.optimizer.adam.state.values()} == made != {6.0}
    swm.wm.engine._command(["swm", "train", "--output", str(tmp_path / "engine"), "--resume"])
    assert log_of(tmp_path / "engine")[-1]["step"] == 6


def test_the_state_of_the_optimizer_does_not_depend_on_the_default_type(rooms, tmp_path):
    trainer = Trainer(Options("gcivl", rooms, out=str(tmp_path / "run"), settings=SHORT, preset="tiny", device="cpu"))
    trainer.train(until=1)
    state = next(iter(trainer.optimizer.adam.state.values()))
    state["step"] = torch.tensor(1001.0)
    torch.set_default_dtype(torch.bfloat16)
    try:
        found = trainer.optimizer.moments(1003, trainer.scaler)
    finally:
        torch.set_default_dtype(torch.float32)
    (steps,) = (value for name, value in found.items() if name.startswith("steps."))
    assert steps.dtype == torch.float32 and steps[0] == 1001


def test_another_default_type_is_refused_before_anything_is_written(rooms, tmp_path):
    torch.set_default_dtype(torch.float64)
    try:
        with pytest.raises(ValueError, match=r"float64.*set_default_dtype"):
            torch_train("pldm", rooms, tmp_path / "run", SHORT)
    finally:
        torch.set_default_dtype(torch.float32)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("family", ["lewm", "dino_wm", "tdmpc2"])
def test_the_engine_plans_with_what_torch_trained(family, rooms, swings, tmp_path):
    data, env = (swings, "swm/PendulumControl-v1") if family == "tdmpc2" else (rooms, "swm/TwoRoom-v1")
    run = torch_train(family, data, tmp_path / "run", SHORT, amp="bf16", compile="eager")
    module, engine = load_pretrained(run), swm.wm.load(run)
    world = swm.World(env, num_envs=2, image_shape=(64, 64), max_episode_steps=10)
    for model in (module, engine):
        world.set_policy(swm.policy.WorldModelPolicy(swm.planning.CEMSolver(model, num_samples=8, n_steps=2, topk=4)))
        assert 0 <= world.evaluate(episodes=2, seed=0)["success_rate"] <= 100


@pytest.mark.parametrize(
    ("kind", "method"),
    [
        *(("LeWM", method) for method in ("_features", "encode", "predict")),
        *(("PreJEPA", method) for method in ("encode", "predict", "decode")),
        *(("TDMPC2", method) for method in ("encode", "forward")),
    ],
)
def test_a_class_of_the_user_is_trained(kind, method, rooms, swings, tmp_path):
    family, data = {"LeWM": ("lewm", rooms), "PreJEPA": ("dino_wm", rooms), "TDMPC2": ("tdmpc2", swings)}[kind]
    base, calls = getattr(swm.wm, kind), []

    def halved(self, *arguments):
        calls.append(arguments)
        found = getattr(base, method)(self, *arguments)
        if isinstance(found, dict):
            name = "reconstructed_pixels" if method == "decode" else "emb"
            return {**found, name: found[name] / 2}
        return tuple(part / 2 for part in found) if isinstance(found, tuple) else found / 2

    settings = [*SHORT, "model.decoder=8"] if method == "decode" else SHORT
    for name, chosen in (("run", type("Halved", (base,), {method: halved})), ("plain", None)):
        torch_train(family, data, tmp_path / name, settings, kind=chosen)
    # TD-MPC2 encodes the first frames and those after them, and predicts each step.
    assert len(calls) % 6 == 0 and calls
    found, plain = weights(tmp_path / "run"), weights(tmp_path / "plain")
    assert any(not torch.equal(found[key], plain[key]) for key in plain)


def test_a_class_that_changes_nothing_trains_the_same_weights(rooms, tmp_path):
    class Same(swm.wm.LeWM):
        def encode(self, info):
            return super().encode(info)

        def predict(self, emb, act_emb):
            return super().predict(emb, act_emb)

    for name, kind in (("same", Same), ("plain", None)):
        torch_train("lewm", rooms, tmp_path / name, SHORT, kind=kind)
    found, plain = weights(tmp_path / "same"), weights(tmp_path / "plain")
    # The actions of overlapping windows are encoded once.
    assert distance(found, plain) < 1e-3


@pytest.mark.parametrize("method", ["encode", "predict_actions", "predict_values"])
def test_a_class_whose_methods_training_does_not_call_is_refused(method, rooms, tmp_path):
    kind = type("Mine", (swm.wm.GCRL,), {method: lambda self, *arguments: None})
    with pytest.raises(TypeError, match=f"Mine.{method}: .*would not call"):
        torch_train("gcbc", rooms, tmp_path / "run", SHORT, kind=kind)
    assert not (tmp_path / "run").exists()


def test_several_processes_refuse_a_class_that_encodes_otherwise():
    kind = type("Mine", (swm.wm.LeWM,), {"encode": lambda self, info: info})
    losses_of("lewm").check_kind(kind, Ranks())
    with pytest.raises(TypeError, match=r"Mine.encode: 2 processes .*one process"):
        losses_of("lewm").check_kind(kind, Ranks(0, 2))


#: Computes the gradients of batches, whose slices the processes have, and saves the sums.
PROGRAM = """
import sys, torch
from stable_worldmodel.train import Options, Trainer

torch.set_num_threads(1)
data, folder, cases, *settings = sys.argv[1:]
found = {}
for family, count in (case.split(":") for case in cases.split(",")):
    run = f"{folder}/{family}-{count}"
    more = ["loss.entropy=0.0", "model.dropout=0.0"] if family == "tdmpc2" else []
    trainer = Trainer(Options(family, data, out=run, preset="tiny", device="cpu", settings=[*settings, *more]))
    steps, count, ranks = trainer.config["data"]["num_steps"], int(count), trainer.ranks
    torch.manual_seed(0)
    lengths = {"pixels": steps, "goal_pixels": 1, "policy_goal_pixels": 1}
    whole = {name: torch.randint(0, 256, (10, length, 3, 64, 64), dtype=torch.uint8) for name, length in lengths.items()}
    whole["action"] = torch.randn(10, steps, 2 * trainer.model.action_block)
    whole |= {"state": torch.randn(10, steps, 2), "reward": torch.randn(10, steps, 1), "terminated": torch.zeros(10, steps, 1)}
    sizes = [count // ranks.size + (rank < count % ranks.size) for rank in range(ranks.size)]
    begin = sum(sizes[: ranks.rank])
    batch = {name: value[begin : begin + sizes[ranks.rank]] for name, value in whole.items()}
    trainer.losses.train_mode()
    trainer._seed(0)
    computed = trainer.losses(batch, ranks.sizes(len(batch["action"]), trainer.device))
    loss = torch.zeros(1)
    if computed:
        share = trainer.losses.share(sizes)
        (computed["loss"] * share).backward()
        loss += computed["loss"].detach() * share
    found[run.rpartition("/")[2]] = {"loss": ranks.add_up(trainer.model, loss)} | {
        name: value.grad for name, value in trainer.model.named_parameters() if value.grad is not None
    }
if ranks.rank == 0:
    torch.save(found, f"{folder}/found.pt")
ranks.leave()
"""


def launched(world_size, *arguments):
    """Runs a program of Python in several processes with `torchrun`."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={world_size}", *arguments]
    command = command if world_size > 1 else [sys.executable, *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def test_gradients_do_not_depend_on_the_number_of_processes(rooms, tmp_path):
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    cases, found = ["gcbc:10", "gciql:2", "lewm:10", "pldm:3", "dino_wm:3", "tdmpc2:3"], {}
    for size in (1, 2, 3, 4):
        folder = tmp_path / str(size)
        folder.mkdir()
        launched(size, str(program), rooms, str(folder), ",".join(cases), *SHORT)
        found[size] = torch.load(folder / "found.pt", weights_only=True)
    for case in (case.replace(":", "-") for case in cases):
        one = found[1][case]
        largest = max(value.abs().max() for name, value in one.items() if name != "loss")
        for size in (2, 3, 4):
            several = found[size][case]
            assert several.keys() == one.keys()
            for name, expected in one.items():
                scale = expected.abs().max() if name == "loss" else largest
                assert (several[name] - expected).abs().max() <= 1e-5 * scale, f"{case}: {name} of {size} processes"


def test_torchrun_trains_in_two_processes(rooms, tmp_path):
    settings = [*SHORT, "validation.every=3", "validation.batches=2", "optim.ema=0.5"]
    for size in (1, 2):
        arguments = ["pldm", f"data={rooms}", f"out={tmp_path / str(size)}", "preset=tiny", "device=cpu", *settings]
        assert launched(size, "-m", "stable_worldmodel.train", *arguments).strip().endswith(str(size))
    assert_close(weights(tmp_path / "2"), weights(tmp_path / "1"), 1e-3)
    for one, two in zip(log_of(tmp_path / "1"), log_of(tmp_path / "2"), strict=True):
        name = "loss" if "loss" in one else "validation/loss"
        assert two["step"] == one["step"] and two[name] == pytest.approx(one[name], rel=1e-3)
    assert (tmp_path / "2/best/checkpoint/weights.safetensors").is_file()


def command(*arguments, **options):
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    return subprocess.Popen(
        [sys.executable, "-m", "stable_worldmodel.train", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        **options,
    )


def test_ctrl_c_saves_the_checkpoint(rooms, tmp_path):
    run = tmp_path / "run"
    arguments = [
        "gcbc",
        f"data={rooms}",
        f"out={run}",
        "device=cpu",
        "data.batch_size=4",
        "schedule.steps=100000",
        "log_every=1",
    ]
    child = command(*arguments)
    log = run / "train.jsonl"
    while child.poll() is None and not (log.is_file() and log.stat().st_size):
        time.sleep(0.05)
    child.send_signal(signal.SIGINT)
    _, errors = child.communicate(timeout=60)
    assert child.returncode == 130 and "resume=true" in errors
    step = json.loads((run / "checkpoint/state.json").read_text())["step"]
    assert step == log_of(run)[-1]["step"] > 0
    trainer = Trainer(parsed("gcbc", [*arguments[1:], "resume=true"]))
    assert trainer.step == step


def test_null_stands_for_a_missing_option():
    options = parsed("lewm", ["data=rooms.lance", "out=null", "preset=null"])
    assert (options.out, options.preset, options.run.name) == (None, None, "lewm-rooms")


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        ([], 2, "usage"),
        (["lewm", "data=nothing", "data=other"], 2, "given twice"),
        (["lewm", "data="], 2, "is empty"),
        (["lewm", "data=nothing", "out="], 2, "out: the name of the checkpoint is empty"),
        (["lewm", "data=nothing", "out=s3://bucket/run"], 2, "out: 's3://bucket/run' is a URI"),
        (["lewm", "data=nothing", "threads=1000000"], 2, "threads: 1000000; expected 0 to 1024"),
        (["lewm", "data=nothing", "compile=nope"], 2, "compile: 'nope'; expected true, false or a backend"),
        (["lewm"], 2, "data=PATH"),
        (["lewm", "data=nothing"], 1, "nothing"),
        (["lewm", "data"], 2, "KEY=VALUE"),
        (["inverse", "data=nothing"], 2, "swm train"),
        (["lewm", "data=nothing", "amp=half"], 2, "bf16"),
        (["lewm", "data=nothing", "resume=maybe"], 2, "true or false"),
        (["lewm", "data=nothing", "threads=many"], 2, "whole number"),
        (["lewm", "data=nothing", "device=fast"], 2, "device"),
        (["lewm", "data=nothing", "device=meta"], 2, "device: 'meta' is not available"),
        (["lewm", "data=nothing", "device=cpu", "compile=tvm"], 2, "compile: 'tvm' does not work here"),
    ],
)
def test_wrong_arguments_are_refused_with_the_reason(arguments, code, message, capsys):
    from stable_worldmodel.train.__main__ import main

    assert main(arguments) == code
    printed = capsys.readouterr()
    assert message in printed.err + printed.out


def test_unknown_options_of_a_call_are_named_with_the_known_ones(rooms):
    with pytest.raises(TypeError, match=r"^log_every: .*the options are out, preset,.* settings=\['log_every=3'\]"):
        train("lewm", rooms, log_every=3)


def test_engine_training_without_a_name_returns_that_of_its_checkpoint(rooms, home):
    name = swm.wm.train("gcbc", data=rooms, preset="tiny", schedule__steps=1, data__batch_size=4)
    assert name == "gcbc-rooms" and (home / "checkpoints" / name).is_dir()
    assert swm.wm.load(name).card["family"] == "gcbc"


def test_unknown_settings_are_refused(rooms, tmp_path):
    with pytest.raises(ValueError, match="model.latnt.*latent"):
        torch_train("lewm", rooms, tmp_path / "run", ["model.latnt=4"])
    assert not (tmp_path / "run").exists()


def test_a_loss_that_is_not_finite_ends_the_training(rooms, tmp_path):
    with pytest.raises(FloatingPointError, match="optim.lr"):
        torch_train("gcbc", rooms, tmp_path / "run", ["optim.lr=1e30", "schedule.warmup=0", "data.batch_size=4"])
    assert np.isfinite(swm.wm.load(str(tmp_path / "run")).card["action_std"]).all()


@pytest.mark.parametrize("training", [engine_train, torch_train])
def test_a_validation_loss_that_is_not_finite_ends_the_training(training, tmp_path):
    rng = np.random.default_rng(0)
    held_out, path = (4, 6, 16, 23, 24, 32), str(tmp_path / "nan.lance")
    with swm.data.open_writer(path) as writer:
        for episode in range(40):
            state = rng.normal(size=(20, 4)).astype(np.float32)
            state[5] += np.nan if episode in held_out else 0.0
            action = rng.normal(size=(19, 2)).astype(np.float32)
            writer.write_episode({"state": state, "action": action, "reward": np.zeros(20), "terminated": np.zeros(20, bool)})
    settings = ["schedule.steps=4", "data.batch_size=32", "data.hold_out=true", "validation.every=2", "validation.batches=1"]
    with pytest.raises(
        (FloatingPointError, ValueError), match="validation loss.*not finite after step 2|after step 2 is not finite"
    ):
        training("tdmpc2", path, tmp_path / "run", settings)
    assert not (tmp_path / "run/best").exists() and weights(tmp_path / "run"), "the weights are kept"


def test_a_class_of_another_family_is_refused_before_anything_is_written(rooms, tmp_path):
    with pytest.raises(TypeError, match="'gcbc' is a GCRL, not a LeWM; derive the class from GCRL"):
        torch_train("gcbc", rooms, tmp_path / "run", SHORT, kind=swm.wm.LeWM)
    assert not (tmp_path / "run").exists()


def test_a_batch_that_the_data_do_not_fill_is_refused_before_anything_is_written(rooms, tmp_path):
    with pytest.raises(ValueError, match="clips do not fill one batch of 100000"):
        torch_train("lewm", rooms, tmp_path / "run", ["data.batch_size=100000", *SHORT[1:]])
    assert not (tmp_path / "run/checkpoint").exists()


def test_a_gradient_of_infinite_norm_ends_the_training(rooms, tmp_path):
    settings = [*SHORT, "loss.weight=1e30"]
    with pytest.raises(FloatingPointError, match="norm of the gradient at training step 1 is inf.*optim.lr or the weights"):
        torch_train("lewm", rooms, tmp_path / "run", settings)
    # The scaler of half precision leaves such steps out, and lowers the scale.
    run = torch_train("lewm", rooms, tmp_path / "half", settings, amp="fp16")
    rows = log_of(run)
    assert [row["step"] for row in rows] == [2, 4, 6] and rows[0]["gradient_norm"] is None


def test_hydra_runs_several_trainings(rooms, tmp_path):
    pytest.importorskip("hydra")
    sweep = [
        "--multirun",
        "model.latent=3,4",
        "model.encoder.pyramid.dim=32",
        "seed=1",
        f"hydra.sweep.dir={tmp_path / 'sweep'}",
    ]
    # Hydra would read the name as a number.
    (tmp_path / "home/datasets").mkdir(parents=True)
    shutil.copytree(rooms, tmp_path / "home/datasets/2026_11_29.lance")
    child = command("lewm", "data=2026_11_29", "preset=tiny", "device=cpu", *SHORT, *sweep, cwd=tmp_path)
    printed, errors = child.communicate(timeout=300)
    assert child.returncode == 0, errors
    for job, latent in enumerate((3, 4)):
        module = load_pretrained(tmp_path / f"sweep/{job}/run")
        assert module.stored.config["model"]["latent"] == latent and module.stored.config["seed"] == 1
        assert module.stored.config["model"]["encoder"]["pyramid"]["dim"] == 32


def test_a_setting_that_is_given_twice_is_refused(rooms, tmp_path):
    pytest.importorskip("hydra")
    twice = ["--multirun", "seed=1", "model.latent=3", "seed=2"]
    child = command("lewm", f"data={rooms}", "preset=tiny", "device=cpu", *twice, cwd=tmp_path)
    _, errors = child.communicate(timeout=300)
    assert child.returncode == 2 and "seed: given twice" in errors, errors


def test_without_hydra_its_flags_are_refused(rooms):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    program = "import sys; sys.modules['hydra'] = None; from stable_worldmodel.train.__main__ import main; "
    program += "sys.exit(main(['lewm', 'data=x', '--multirun']))"
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert done.returncode == 2 and "pip install hydra-core" in done.stderr


def test_a_second_training_in_a_folder_is_refused(rooms, tmp_path):
    import fcntl

    out = tmp_path / "run"
    options = Options("gcbc", rooms, out=str(out), preset="tiny", device="cpu", settings=SHORT)
    trainer = Trainer(options)
    # The lock that the engine's trainings take.
    held = os.open(out, os.O_RDONLY)
    fcntl.flock(held, fcntl.LOCK_EX)
    with pytest.raises(ValueError, match="another process writes to it"):
        trainer.train()
    os.close(held)
    # A kill after step 3 lost a line in the middle; the checkpoint is that of step 0.
    (out / "train.jsonl").write_text('{"step": 1, "loss": 1.0}\n{"step": 2, "lo')
    Trainer(Options(**{**vars(options), "resume": True})).train()
    assert [line["step"] for line in log_of(out)] == [2, 4, 6]


@pytest.mark.parametrize("by", ["engine", "torch"])
def test_settings_of_a_call_are_written_as_the_command_reads_them(by, rooms, tmp_path):
    given = {
        "schedule__steps": np.int64(2),
        "data__batch_size": 4,
        "data__hold_out": False,
        "optim__betas": (0.8, 0.5),
        "optim__lr": np.float32(3e-4),
        "model__encoder": {"conv": {"channels": np.array([6, 8]), "hidden": 12, "dim": 10}},
    }
    out = str(tmp_path / "run")
    if by == "engine":
        swm.wm.train("gcbc", data=rooms, out=out, preset="tiny", **given)
        with pytest.raises(ValueError, match="resume=True"):
            swm.wm.train("gcbc", data=rooms, out=out, preset="tiny", **given)
        swm.wm.train("gcbc", data=rooms, out=out, preset="tiny", resume=True, **given)
    else:
        train("gcbc", rooms, out=out, preset="tiny", device="cpu", **given)
    config = json.loads((tmp_path / "run/checkpoint/config.json").read_text())["config"]
    assert config["data"]["hold_out"] is False and config["optim"]["betas"] == [0.8, 0.5]
    assert config["optim"]["lr"] == 3e-4 and config["model"]["encoder"]["conv"]["channels"] == [6, 8]
    with pytest.raises(ValueError, match="data.hold_out: is 'no', expected true or false"):
        train("gcbc", rooms, out=str(tmp_path / "other"), preset="tiny", device="cpu", data__hold_out="no")
