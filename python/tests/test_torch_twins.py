"""Tests that torch modules of the engine's checkpoints compute what the engine computes, and are saved as its checkpoints."""

import json

import numpy as np
import pytest

import stable_worldmodel as swm

torch = pytest.importorskip("torch")
torch.set_num_threads(1)

from stable_worldmodel.wm.utils import load_pretrained  # noqa: E402

#: The settings of a training of seconds.
SHORT = {"preset": "tiny", "data__batch_size": 8, "schedule__steps": 6, "schedule__warmup": 1, "shards": 1}
VIT = "{vit={patch=16,dim=24,depth=2,heads=2,mlp=32}}"
DINO = "{dinov2={patch=8,dim=24,depth=2,heads=2,mlp=32,grid=8}}"
REGISTERS = "{dinov2={patch=8,dim=24,depth=1,heads=2,mlp=32,grid=12,registers=2}}"
CONV = "{conv={channels=[6,8],hidden=12,dim=10}}"
KEYPOINTS = (
    "{keypoints={filters=[{kernel=5,stride=2,channels=6},{kernel=7,stride=4,channels=4}],"
    "colours=[[1.0,0.5,0.0],[-1.0,0.0,0.5]],sharpness=2.0,hidden=[12],dim=10}}"
)
COLOURS = "{keypoints={filters=[],colours=[[2.2,2.2,2.2],[0.5,-1.0,0.3]],sharpness=2.0,hidden=[12],dim=10}}"
STATE = '[{column="pixels",latent=16},{column="state",latent=8}]'


@pytest.fixture(scope="module")
def world():
    return swm.World("swm/TwoRoom-v1", num_envs=3, image_shape=(64, 64), max_episode_steps=25)


@pytest.fixture(scope="module")
def rooms(world, tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "rooms.lance"
    world.collect(path, episodes=8, seed=0, progress=False, policy=swm.policy.RandomPolicy(seed=0))
    return str(path)


def trained(family, rooms, out, **settings):
    swm.wm.train(family, data=rooms, out=str(out), **{**SHORT, **settings})
    return swm.wm.load(str(out))


def infos_of(world, seed=9):
    world.reset(seed=seed)
    return {key: world.infos[key].copy() for key in ("pixels", "goal", "state")}


def costs(module, infos, candidates):
    samples = candidates.shape[1]
    given = {key: torch.from_numpy(value)[:, None].expand(-1, samples, *value.shape[1:]) for key, value in infos.items()}
    with torch.inference_mode():
        return module.get_cost(given, torch.from_numpy(candidates)).numpy()


def assert_equal_costs(engine, module, infos, seed=0):
    size = len(engine.card["action_mean"]) * engine.action_block
    candidates = np.random.default_rng(seed).normal(size=(3, 6, 4, size)).astype(np.float32)
    expected, found = engine.get_cost(infos, candidates), costs(module, infos, candidates)
    assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()
    assert expected.std(1).min() > 1e-5 * np.abs(expected).mean(), "the candidates have different costs"


PLANNED = [
    ("lewm", {}),
    ("lewm", {"model__encoder": VIT, "model__predictor__history": 2}),
    ("lewm", {"model__encoder": DINO}),
    ("lewm", {"model__encoder": CONV, "optim__ema": 0.9}),
    ("lewm", {"model__encoder": KEYPOINTS, "model__decoder": "{hidden=9,weight=2.0}"}),
    ("pldm", {}),
    ("pldm", {"model__encoder": CONV}),
    ("pldm", {"model__encoder": COLOURS, "model__decoder": "{hidden=9,weight=2.0}"}),
    ("dino_wm", {}),
    ("dino_wm", {"model__encoder": REGISTERS, "model__predictor__history": 2, "model__decoder": 8}),
]


@pytest.mark.parametrize(("family", "settings"), PLANNED)
def test_costs_equal_those_of_the_engine(family, settings, world, rooms, tmp_path):
    engine = trained(family, rooms, tmp_path / "run", **settings)
    module = load_pretrained(tmp_path / "run")
    assert module.action_block == engine.action_block and not module.training
    scaler = module.process["action"]
    assert scaler.mean.tolist() == pytest.approx(engine.card["action_mean"])
    assert scaler.std.tolist() == pytest.approx(engine.card["action_std"])
    assert_equal_costs(engine, module, infos_of(world))


ACTING = [
    ("gcbc", {}),
    ("gcbc", {"model__encoder": CONV}),
    ("gcbc", {"model__encoder": KEYPOINTS}),
    ("gcbc", {"model__encoder": COLOURS}),
    ("gcbc", {"model__encoder": VIT, "model__history": 2, "data__num_steps": 2}),
    ("gcivl", {"model__head__depth": 4}),
    ("gcivl", {"model__metric": 6, "model__history": 2, "data__num_steps": 3}),
    ("gciql", {"model__encoder": CONV}),
]


@pytest.mark.parametrize(("family", "settings"), ACTING)
def test_actions_equal_those_of_the_engine(family, settings, world, rooms, tmp_path):
    engine = trained(family, rooms, tmp_path / "run", **settings)
    module = load_pretrained(tmp_path / "run")
    infos = infos_of(world)
    expected = engine.get_action(infos)
    with torch.inference_mode():
        found = module.get_action({key: torch.from_numpy(value) for key, value in infos.items()}).numpy()
    found = module.process["action"].inverse_transform(found)
    assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()
    assert np.ptp(expected, 0).min() > 1e-6 * np.abs(expected).max(), "the environments have different actions"
    world.set_policy(swm.policy.FeedForwardPolicy(module))
    world.reset(seed=9)
    world.step()
    assert np.abs(world.infos["action"].reshape(expected.shape) - expected).max() < 1e-5 * np.abs(expected).max()


def changed(module, seed=0):
    """The module with other weights."""
    torch.manual_seed(seed)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter += 0.05 * torch.randn_like(parameter)
    return module


SAVED = [
    *PLANNED,
    ("tdmpc2", {"model__encoding": STATE, "model__image": 64, "model__termination": "true"}),
    ("tdmpc2", {"loss__uncertainty": 0.5, "data__num_steps": 3}),
    *ACTING,
]


@pytest.mark.parametrize(("family", "settings"), SAVED)
def test_the_engine_loads_what_torch_saved(family, settings, world, rooms, tmp_path):
    before = trained(family, rooms, tmp_path / "run", **settings)
    module = changed(load_pretrained(tmp_path / "run"))
    weights = module.save_pretrained(tmp_path / "saved")
    engine, infos = swm.wm.load(str(tmp_path / "saved")), infos_of(world)
    assert engine.card == {**before.card, "weights": weights} and weights != before.card["weights"]
    if hasattr(module, "get_cost"):
        assert_equal_costs(engine, module, infos)
    else:
        with torch.inference_mode():
            found = module.get_action({key: torch.from_numpy(value) for key, value in infos.items()}).numpy()
        expected = engine.get_action(infos)
        low, high = world.single_action_space.low, world.single_action_space.high
        found = np.clip(module.process["action"].inverse_transform(found), low, high)
        assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()
    again = load_pretrained(tmp_path / "saved")
    assert all(torch.equal(value, again.state_dict()[name]) for name, value in module.state_dict().items())
    assert again.stored.manifest["libraries"] == {"torch": torch.__version__.split("+")[0]}
    assert swm.cli._run("checkpoints", "verify", tmp_path / "saved") is None


def test_saving_replaces_nothing_unasked_and_refuses_other_weights(rooms, tmp_path):
    trained("lewm", rooms, tmp_path / "run")
    module = swm.wm.LeWM.from_pretrained(tmp_path / "run")
    with pytest.raises(ValueError, match="another folder"):
        module.save_pretrained(tmp_path / "run")
    hash = module.save_pretrained(tmp_path / "run", overwrite=True)
    assert hash == swm.wm.load(str(tmp_path / "run")).card["weights"]
    foreign = tmp_path / "foreign/checkpoint/config.json"
    foreign.parent.mkdir(parents=True)
    foreign.write_text('{"model_type": "bert"}')
    with pytest.raises(ValueError, match="none of this program"):
        module.save_pretrained(tmp_path / "foreign", overwrite=True)
    assert foreign.read_text() == '{"model_type": "bert"}' and list(foreign.parent.iterdir()) == [foreign]
    # It would be read in place of the checkpoint.
    own = tmp_path / "own/config.json"
    own.parent.mkdir()
    own.write_text('{"a": 1}')
    with pytest.raises(ValueError, match="own: holds a config.json"):
        module.save_pretrained(own.parent, overwrite=True)
    assert list(own.parent.iterdir()) == [own]
    for path in ("s3://bucket/model", ""):
        with pytest.raises(ValueError, match="a local folder"):
            module.save_pretrained(path)
    with torch.no_grad():
        module.projector.net[0].bias[0] = float("inf")
    with pytest.raises(ValueError, match="not finite"):
        module.save_pretrained(tmp_path / "run", overwrite=True)
    module.projector = torch.nn.Linear(64, 3)
    with pytest.raises(RuntimeError, match="projector"):
        module.save_pretrained(tmp_path / "run", overwrite=True)
    assert hash == swm.wm.load(str(tmp_path / "run")).card["weights"], "the checkpoint is kept"
    module.stored = None
    with pytest.raises(ValueError, match="from_pretrained"):
        module.save_pretrained(tmp_path / "other")
    with pytest.raises(TypeError, match="not a PLDM"):
        swm.wm.PLDM.from_pretrained(tmp_path / "run")
    with pytest.raises(FileNotFoundError):
        swm.wm.PLDM.from_pretrained(tmp_path / "nothing")


def test_names_stand_for_checkpoints_of_the_home_folder(home, rooms):
    trained("gcbc", rooms, "mine")
    swm.wm.GCRL.from_pretrained("mine").save_pretrained("copied")
    assert (home / "checkpoints/copied/checkpoint/weights.safetensors").is_file()
    assert swm.wm.load("copied").card["weights"] == swm.wm.load("mine").card["weights"]


@pytest.mark.parametrize("name", ["two-room/lewm", "two-room/pldm"])
def test_capsules_of_the_zoo_are_modules(name, world):
    engine, module = swm.wm.load(f"zoo:{name}"), load_pretrained(f"zoo:{name}")
    assert_equal_costs(engine, module, infos_of(world))


def test_a_subclass_of_a_checkpoint_is_planned_with_and_saved(world, rooms, tmp_path):
    trained("lewm", rooms, tmp_path / "run")

    class Careful(swm.wm.LeWM):
        def criterion(self, info_dict, action_candidates=None):
            return super().criterion(info_dict) + 0.1 * action_candidates.square().mean((2, 3))

    model = Careful.from_pretrained(tmp_path / "run")
    solver = swm.planning.CEMSolver(model, num_samples=16, n_steps=2, topk=4)
    policy = swm.policy.WorldModelPolicy(solver)
    assert policy.cfg.action_block == model.action_block == 5
    assert policy.process["action"].mean.tolist() == pytest.approx(swm.wm.load(str(tmp_path / "run")).card["action_mean"])
    world.set_policy(policy)
    found = world.evaluate(episodes=2, seed=0)
    assert 0 <= found["success_rate"] <= 100
    model.save_pretrained(tmp_path / "careful")
    assert type(load_pretrained(tmp_path / "careful")) is swm.wm.LeWM


def test_files_that_the_engine_refuses_are_not_loaded(rooms, tmp_path):
    trained("lewm", rooms, tmp_path / "run")
    folder = tmp_path / "run/checkpoint"
    config, weights = (folder / "config.json").read_bytes(), (folder / "weights.safetensors").read_bytes()

    def refused(**files):
        for name, content in {"config.json": config, "weights.safetensors": weights, **files}.items():
            (folder / name).write_bytes(content)
        for path in (tmp_path / "run", folder):
            with pytest.raises(RuntimeError):
                load_pretrained(path)

    assert load_pretrained(folder).stored.config["seed"] == load_pretrained(tmp_path / "run").stored.config["seed"]
    changed = json.loads(config)
    changed["facts"]["action"]["std"] = [10 * std for std in changed["facts"]["action"]["std"]]
    refused(**{"config.json": json.dumps(changed).encode()})
    changed = json.loads(config)
    changed["config"]["model"]["predictor"]["mlp"] = 2_000_000
    refused(**{"config.json": json.dumps(changed).encode()})
    not_finite = np.full(4, np.nan, "<f4").tobytes()
    refused(**{"weights.safetensors": weights[: -len(not_finite)] + not_finite})
