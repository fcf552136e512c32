"""Tests that checkpoints of the engine and of the published package load as torch modules, as data only."""

import contextlib
import json
import os
import resource
import threading
import warnings
import zipfile
from pathlib import Path, PurePosixPath

import numpy as np
import pytest

import stable_worldmodel as swm
from stable_worldmodel import _files

torch = pytest.importorskip("torch")
torch.set_num_threads(1)

from stable_worldmodel.wm import _weights, probes  # noqa: E402
from stable_worldmodel.wm.utils import load_pretrained, save_pretrained  # noqa: E402

GOLDEN = Path(__file__).parents[2] / "crates/swm-models/tests/golden"


@pytest.mark.parametrize("family", ["lewm", "pldm"])
def test_published_checkpoints_compute_the_recorded_outputs(family):
    model = load_pretrained(GOLDEN / "reference" / family).eval()
    recorded = _weights.read_safetensors(GOLDEN / f"reference-{family}.safetensors")
    assert type(model).__name__ == {"lewm": "LeWM", "pldm": "PLDM"}[family]
    with torch.no_grad():
        info = model.encode({"pixels": recorded["i.pixels"], "action": recorded["i.action"]})
        predicted = model.predict(info["emb"], info["act_emb"])
    for actual, expected in ((info["emb"], recorded["o.emb"]), (predicted, recorded["o.pred"])):
        assert (actual - expected).abs().max() < 1e-5 * expected.abs().max()


def test_weights_with_two_names_and_complex_weights_are_refused(tmp_path):
    source = GOLDEN / "reference" / "lewm"
    weights = torch.load(source / "weights.pt", weights_only=True)
    newer = "encoder.layers.0.attention.q_proj.weight"
    older = _weights.published(newer)
    value = weights.pop(newer) if newer in weights else weights.pop(older)
    (tmp_path / "config.json").write_bytes((source / "config.json").read_bytes())

    def load(changed):
        torch.save({**weights, **changed}, tmp_path / "weights.pt")
        return load_pretrained(tmp_path / "weights.pt").state_dict()[older]

    for name in (older, newer):
        assert torch.equal(load({name: value}), value)
    with pytest.raises(RuntimeError, match=f"'{older}' and '{newer}' are two names of one weight"):
        load({older: value, newer: 2 * value})
    with pytest.raises(RuntimeError, match=f"the weight '{newer}' is torch.complex64; expected real numbers"):
        load({newer: torch.complex(value, value)})


def lewm_config():
    module = "stable_worldmodel.wm.lewm.module"
    norm = {"_target_": "torch.nn.BatchNorm1d", "_partial_": True}
    project = {"_target_": f"{module}.MLP", "input_dim": 6, "hidden_dim": 8, "output_dim": 6, "norm_fn": norm}
    sizes = {"num_frames": 3, "depth": 1, "heads": 2, "mlp_dim": 8, "input_dim": 6, "hidden_dim": 8, "output_dim": 6}
    return {
        "_target_": "stable_worldmodel.wm.LeWM",
        "encoder": {"_target_": "torch.nn.Flatten"},
        "predictor": {"_target_": f"{module}.Predictor", **sizes},
        "action_encoder": {"_target_": f"{module}.Embedder", "input_dim": 2, "smoothed_dim": 2, "emb_dim": 6},
        "projector": project,
        "pred_proj": project,
    }


def test_models_are_saved_and_loaded(home):
    from stable_worldmodel.wm._build import build

    model = build(lewm_config())
    save_pretrained(model, "mine", {"model": lewm_config(), "other": 1}, "model")
    assert (home / "checkpoints/mine/weights.pt").is_file()
    again = load_pretrained("mine")
    assert all(torch.equal(value, again.state_dict()[name]) for name, value in model.state_dict().items())
    assert load_pretrained("mine/weights.pt").predictor.num_frames == 3
    found = swm.policy.AutoCostModel("mine")
    assert isinstance(found, swm.wm.LeWM) and not found.training
    assert isinstance(swm.policy.AutoCostModel("mine", cache_dir=home), swm.wm.LeWM)
    with pytest.raises(FileNotFoundError, match="other"):
        swm.policy.AutoCostModel("other")
    with pytest.raises(RuntimeError, match="missing|size"):
        load_pretrained("mine", extra_args={"predictor.depth": 2})
    with pytest.warns(UserWarning, match="without a config"):
        save_pretrained(model, "bare")
    with pytest.raises(FileNotFoundError, match="config.json"):
        load_pretrained("bare")
    save_pretrained(model, "mine", lewm_config(), filename="second.pt")
    with pytest.raises(ValueError, match="second.pt"):
        load_pretrained("mine")
    with pytest.raises(FileNotFoundError, match="nothing"):
        load_pretrained("nothing")


def test_an_existing_path_counts_before_a_name(home, rooms, tmp_path, monkeypatch):
    from stable_worldmodel.wm._build import build

    linear = {"_target_": "torch.nn.Linear", "in_features": 2, "out_features": 3}
    for name in ("both", "run"):
        save_pretrained(build(lewm_config()), name, lewm_config())
    monkeypatch.chdir(tmp_path)
    assert isinstance(load_pretrained("both"), swm.wm.LeWM) and isinstance(swm.policy.AutoCostModel("both"), swm.wm.LeWM)
    save_pretrained(torch.nn.Linear(2, 3), "both", linear, cache_dir=tmp_path / "other")
    (tmp_path / "other/checkpoints/both").rename(tmp_path / "both")
    swm.wm.train("gcbc", data=rooms, out="./run", preset="tiny", schedule__steps=1, data__batch_size=4)
    for load in (load_pretrained, swm.policy.AutoCostModel):
        assert isinstance(load("both"), torch.nn.Linear)
        assert isinstance(load("both", cache_dir=home), swm.wm.LeWM), "the folder that is given counts first"
    assert isinstance(load_pretrained("run"), swm.wm.GCRL)
    assert swm.policy.AutoCostModel("run").card["family"] == swm.wm.load("run").card["family"] == "gcbc"
    assert isinstance(swm.wm.GCRL.from_pretrained("run"), swm.wm.GCRL)


def test_files_and_folders_without_a_checkpoint_hide_no_name(home, rooms, tmp_path, monkeypatch):
    linear = {"_target_": "torch.nn.Linear", "in_features": 2, "out_features": 3}
    save_pretrained(torch.nn.Linear(2, 3), "saved", linear)
    save_pretrained(torch.nn.Linear(2, 3), "given", linear, cache_dir=tmp_path / "cache")
    swm.wm.train("gcbc", data=rooms, out="run", preset="tiny", schedule__steps=1, data__batch_size=4)
    auto = swm.policy.AutoCostModel
    # An empty folder, a folder of other files, and a file.
    for i, make in enumerate((Path.mkdir, lambda path: (path / "checkpoint").mkdir(parents=True), Path.touch)):
        (tmp_path / str(i)).mkdir()
        monkeypatch.chdir(tmp_path / str(i))
        for name in ("saved", "given", "run", "other"):
            make(Path(name))
        make(tmp_path / "cache" / str(i))
        for load in (load_pretrained, auto):
            assert isinstance(load("saved"), torch.nn.Linear)
            assert isinstance(load("given", cache_dir=tmp_path / "cache"), torch.nn.Linear)
            # It is what the error is about.
            with pytest.raises((FileNotFoundError, RuntimeError, ValueError), match="config.json|other: "):
                load("other")
        assert isinstance(load_pretrained("run"), swm.wm.GCRL)
        assert auto("run").path == str(home / "checkpoints/run")
    assert isinstance(auto(home / "checkpoints/saved/weights.pt"), torch.nn.Linear)


def test_models_are_saved_on_this_machine(home, rooms, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "user"))
    linear = {"_target_": "torch.nn.Linear", "in_features": 2, "out_features": 3}
    for given in ({"run_name": "s3://bucket/x"}, {"run_name": "x", "cache_dir": "gs://bucket"}):
        with pytest.raises(ValueError, match="is a URI; expected a path of this machine"):
            save_pretrained(torch.nn.Linear(2, 3), config=linear, **given)
    for name in ("", ".", "..", "a/.."):
        with pytest.raises(ValueError, match="run_name: expected a name or a local folder"):
            save_pretrained(torch.nn.Linear(2, 3), name, linear)
    with pytest.raises(FileNotFoundError, match="there is no checkpoint ''"):
        load_pretrained("")
    assert not list(home.rglob("weights.pt"))
    for given, folder in (({"run_name": "~/x"}, "x"), ({"run_name": "y", "cache_dir": "~/c"}, "c/checkpoints/y")):
        save_pretrained(torch.nn.Linear(2, 3), config=linear, **given)
        assert (tmp_path / "user" / folder / "weights.pt").is_file()
    assert isinstance(load_pretrained("~/x"), torch.nn.Linear)
    assert isinstance(load_pretrained("y", cache_dir="~/c"), torch.nn.Linear)
    swm.wm.train("gcbc", data=rooms, preset="tiny", schedule__steps=1, data__batch_size=4)
    swm.wm.GCRL.from_pretrained("gcbc-rooms").save_pretrained("~/z")
    assert swm.wm.load("~/z").path == str(tmp_path / "user/z")
    assert not (tmp_path / "~").exists() and not list(home.rglob("*:"))


def test_weights_beside_another_configuration_are_loaded_with_a_warning(home):
    def config(name):
        return {"_target_": "torch.nn.Sequential", "_args_": [{"_target_": f"torch.nn.{name}"}]}

    save_pretrained(torch.nn.Sequential(torch.nn.Tanh()), "run", config("Tanh"), filename="first.pt")
    folder = home / "checkpoints" / "run"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_pretrained(folder / "first.pt")
    save_pretrained(torch.nn.Sequential(torch.nn.ReLU()), "run", config("ReLU"), filename="second.pt")
    with pytest.warns(UserWarning, match="first.pt was saved with another configuration"):
        load_pretrained(folder / "first.pt")
    with pytest.warns(UserWarning, match="saved without a config"):
        save_pretrained(torch.nn.Sequential(torch.nn.Tanh()), "run", filename="third.pt")
    with pytest.warns(UserWarning, match="third.pt was saved without a configuration"):
        load_pretrained(folder / "third.pt")


def test_models_are_replaced_as_a_whole_and_checkpoints_of_the_engine_are_not(home):
    def config(size):
        return {"_target_": "torch.nn.Linear", "in_features": size, "out_features": size}

    save_pretrained(torch.nn.Linear(4, 4), "mine", config(4))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
        with pytest.raises((OSError, RuntimeError)):
            save_pretrained(torch.nn.Linear(300, 300), "mine", config(300))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert load_pretrained("mine").in_features == 4
    assert sorted(file.name for file in (home / "checkpoints/mine").iterdir()) == ["config.json", "weights.pt"]
    save_pretrained(torch.nn.Linear(5, 5), "mine", config(5))
    assert load_pretrained("mine").in_features == 5
    run = home / "checkpoints/run/checkpoint"
    run.mkdir(parents=True)
    (run / "config.json").write_text("{}")
    with pytest.raises(FileExistsError, match="choose another run_name"):
        save_pretrained(torch.nn.Linear(5, 5), "run/checkpoint", config(5))
    assert [file.name for file in run.iterdir()] == ["config.json"]


def test_configurations_of_many_modules_or_without_memory_are_refused(home):
    layer = {"_target_": "torch.nn.Linear", "in_features": 2, "out_features": 2}
    save_pretrained(torch.nn.Linear(2, 2), "mine", {**layer, "device": "meta"})
    with pytest.raises(ValueError, match="meta"):
        load_pretrained("mine")
    many = {"_target_": "torch.nn.Sequential", "_args_": [{"_target_": "torch.nn.Identity"}] * 5000}
    save_pretrained(torch.nn.Linear(2, 2), "many", many)
    with pytest.raises(ValueError, match="5001 modules"):
        load_pretrained("many")


def test_numbers_that_no_file_of_weights_needs_are_refused(home):
    """Each takes gigabytes before there is a tensor, or in a frame that only finds a size."""
    attention = {"_target_": "stable_worldmodel.wm.gcrl.module.Attention", "dim": 1, "heads": 1, "dim_head": 1}
    save_pretrained(torch.nn.Linear(2, 2), "frames", {**attention, "num_frames": 2_000_000_000})
    with pytest.raises(ValueError, match="the number 2000000000"):
        load_pretrained("frames")
    save_pretrained(torch.nn.Linear(2, 2), "tokens", {**attention, "num_frames": 100_000, "num_patches": 100_000})
    with pytest.raises(RuntimeError, match="do not fit Attention"):
        load_pretrained("tokens")
    small = {"mlp_dim": 1, "num_bins": 2, "enc_dim": 1, "num_q": 1, "vmin": -1, "vmax": 1, "simnorm_dim": 8}
    sizes = {"action_dim": 1, "image_size": 30_000, "wm": {"encoding": {"pixels": 0, "x": 8}, **small}, "extra_dims": {"x": 1}}
    save_pretrained(torch.nn.Linear(2, 2), "side", {"_target_": "stable_worldmodel.wm.tdmpc2.tdmpc2.TDMPC2", "cfg": sizes})
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises((ValueError, RuntimeError)):
        load_pretrained("side")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1 << 20  # KiB


def test_files_of_the_user_and_of_the_engine_are_not_replaced(home):
    config = {"_target_": "torch.nn.Linear", "in_features": 2, "out_features": 2}
    model, folder = torch.nn.Linear(2, 2), home / "checkpoints/mine"
    folder.mkdir(parents=True)
    contents = {"model.pt": "a text", "config.json": '{"_target_": "mine"}', "thesis.txt": "a thesis"}
    scripted = torch.jit.script(torch.nn.Linear(2, 2))
    for name, content in contents.items():
        (folder / name).write_text(content)
    for name in ("weights.pt", "model.pt", "thesis.txt"):
        with pytest.raises(FileExistsError, match="did not write"):
            save_pretrained(model, "mine", config, filename=name)
    with pytest.raises(FileExistsError, match="thesis"):
        save_pretrained(model, "mine", filename="thesis.txt")
    assert {file.name: file.read_text() for file in folder.iterdir()} == contents
    for name in ("config.json", "weights.safetensors", "../weights.pt", ""):
        with pytest.raises(ValueError, match="plain name"):
            save_pretrained(model, "new", config, filename=name)
    torch.jit.save(scripted, folder / "scripted.pt")
    with pytest.raises(FileExistsError, match="did not write"):
        save_pretrained(model, "mine", config, filename="scripted.pt")
    # Those of a training script of the user: neither its settings nor its weights.
    script = home / "checkpoints/script"
    script.mkdir()
    settings = json.dumps({**config, "notes": "the only copy"}, indent=2)
    (script / "config.json").write_text(settings)
    torch.save({"step": 7}, script / "weights.pt")
    before = (script / "weights.pt").read_bytes()
    for name in ("weights.pt", "other.pt"):
        with pytest.raises(FileExistsError, match="did not write"):
            save_pretrained(model, "script", config, filename=name)
    assert (script / "config.json").read_text() == settings and (script / "weights.pt").read_bytes() == before
    # Nor its own configuration after a change.
    save_pretrained(model, "changed", config)
    changed = home / "checkpoints/changed/config.json"
    changed.write_text(changed.read_text().replace("2", "3"))
    with pytest.raises(FileExistsError, match="did not write"):
        save_pretrained(model, "changed", config)
    # Its own files are replaced, whatever the configuration.
    for plain in ({"hidden": 3}, {}, [1, 2], {**config, "_partial_": True}, config):
        for _ in range(2):
            with warnings.catch_warnings(record=True) as found:
                warnings.simplefilter("always")
                save_pretrained(model, f"plain-{type(plain).__name__}-{len(plain)}", plain)
            assert ["describes no module" in str(warning.message) for warning in found] == [True] * (plain != config)
    # The configuration that it would write again is its own, also after the other weights were removed.
    save_pretrained(model, "again", config)
    (home / "checkpoints/again/weights.pt").unlink()
    save_pretrained(model, "again", config, filename="second.pt")
    assert isinstance(load_pretrained("again"), torch.nn.Linear)
    (folder / "weights.safetensors").write_text("weights of the engine")
    with pytest.raises(FileExistsError, match="of the engine"):
        save_pretrained(model, "mine", filename="new.pt")
    assert not (home / "checkpoints/new").exists() and not (folder / "new.pt").exists()


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "builtins.eval",
        "subprocess.run",
        "torch.load",
        "torch.nn.functional.relu",
        "stable_worldmodel.wm.engine.train",
        "stable_worldmodel.wm.utils.save_pretrained",
        "stable_worldmodel.wm.engine.os.system",
        "stable_worldmodel.wm._build.build",
        "stable_worldmodel.wm.nothing.There",
    ],
)
def test_targets_that_run_code_are_refused(home, target):
    folder = home / "checkpoints/evil"
    folder.mkdir(parents=True)
    torch.save({}, folder / "weights.pt")
    (folder / "config.json").write_text(json.dumps({**lewm_config(), "encoder": {"_target_": target}}))
    with pytest.raises(ValueError, match="_target_"):
        load_pretrained("evil")


@pytest.mark.parametrize(
    "given",
    [
        {"name": "hf-hub:evil/model"},
        {"name": "local-dir:/tmp/evil"},
        {"name": "resnet18", "checkpoint_path": "/tmp/evil.pth"},
        {"name": "resnet18", "pretrained_cfg": {"url": "http://127.0.0.1:9/evil.pth"}},
        {"name": "resnet18", "pretrained_cfg_overlay": {"file": "/tmp/evil.pth"}},
    ],
)
def test_encoders_of_timm_are_not_loaded_from_where_a_file_says(home, given):
    folder = home / "checkpoints/evil"
    folder.mkdir(parents=True)
    torch.save({}, folder / "weights.pt")
    for path in ("prejepa.module.TimmEncoder", "prejepa.TimmEncoder"):
        target = {"_target_": f"stable_worldmodel.wm.{path}", **given}
        (folder / "config.json").write_text(json.dumps({**lewm_config(), "encoder": target}))
        with pytest.raises(ValueError, match="TimmEncoder"):
            load_pretrained("evil")


def test_an_encoder_of_timm_gets_its_weights_from_the_file_alone(home):
    pytest.importorskip("timm")
    from stable_worldmodel.wm.prejepa.module import TimmEncoder

    encoder = TimmEncoder("resnet10t", pretrained=False)
    target = "stable_worldmodel.wm.prejepa.module.TimmEncoder"
    save_pretrained(encoder, "mine", {"_target_": target, "name": "resnet10t", "pretrained": True})
    again = load_pretrained("mine")
    assert all(torch.equal(value, again.state_dict()[name]) for name, value in encoder.state_dict().items())


@pytest.mark.parametrize(
    "target",
    [
        {"_target_": "torch.nn.Linear", "in_features": 200_000, "out_features": 200_000},
        {"_target_": "stable_pretraining.backbone.utils.vit_hf", "num_hidden_layers": 1_000_000},
        {"_target_": "stable_pretraining.backbone.utils.vit_hf", "hidden_size": 1 << 20},
        {
            "_target_": "stable_worldmodel.wm.prejepa.module.Attention",
            "dim": 4,
            "num_patches": 1 << 20,
            "num_frames": 1 << 10,
        },
    ],
)
def test_models_that_are_larger_than_their_weights_take_no_memory(home, target):
    folder = home / "checkpoints/evil"
    folder.mkdir(parents=True)
    # Elements that share one number take no space in a file.
    torch.save({"weight": torch.zeros(1).expand(200_000, 200_000)}, folder / "weights.pt")
    (folder / "config.json").write_text(json.dumps(target))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match="larger model than the file"):
        load_pretrained("evil")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000, "kilobytes"


def test_compressed_weights_and_long_configurations_are_refused(home):
    folder = home / "checkpoints/evil"
    folder.mkdir(parents=True)
    settings = {"_target_": "torch.nn.Linear", "in_features": 4, "out_features": 4}
    torch.save(torch.nn.Linear(4, 4).state_dict(), folder / "stored.pt")
    with (
        zipfile.ZipFile(folder / "stored.pt") as stored,
        zipfile.ZipFile(folder / "weights.pt", "w", zipfile.ZIP_DEFLATED) as packed,
    ):
        for name in stored.namelist():
            packed.writestr(name, stored.read(name))
    (folder / "config.json").write_text(json.dumps(settings))
    assert load_pretrained(folder / "stored.pt").in_features == 4
    with pytest.raises(RuntimeError, match="is compressed"):
        load_pretrained(folder / "weights.pt")
    with (folder / "config.json").open("ab") as file:
        file.truncate(4 << 30)
    with pytest.raises(ValueError, match="expected the configuration of a model"):
        load_pretrained(folder / "stored.pt")


def test_changed_bytes_of_weights_are_noticed(home, tmp_path):
    network = torch.nn.Linear(16, 8)
    torch.save(network.state_dict(), tmp_path / "weights.pt")
    stored = (tmp_path / "weights.pt").read_bytes()
    at = stored.index(network.weight.detach().numpy().tobytes())
    changed = bytearray(stored)
    changed[at + 7] ^= 8
    settings = {"_target_": "torch.nn.Linear", "in_features": 16, "out_features": 8}
    (tmp_path / "config.json").write_text(json.dumps(settings))
    assert torch.equal(load_pretrained(tmp_path).weight, network.weight)
    (tmp_path / "weights.pt").write_bytes(changed)
    with pytest.raises(RuntimeError, match="is damaged, its checksum differs"):
        load_pretrained(tmp_path)
    with zipfile.ZipFile(tmp_path / "twice.pt", "w") as twice, zipfile.ZipFile(GOLDEN / "reference/lewm/weights.pt") as one:
        with pytest.warns(UserWarning, match="Duplicate name"):
            for name in [*one.namelist(), one.namelist()[-1]]:
                twice.writestr(name, one.read(name))
    with pytest.raises(RuntimeError, match="is in it twice"):
        _weights.read_state_dict(tmp_path / "twice.pt")
    probes.attach_probe(network, "one", torch.nn.Linear(16, 8))
    with pytest.raises(RuntimeError, match="is damaged, its checksum differs"):
        probes.load_probe(network, "one", tmp_path / "weights.pt")


def test_pickled_code_of_weights_does_not_run(home, tmp_path):
    class Evil:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "ran",))

    folder = home / "checkpoints/evil"
    folder.mkdir(parents=True)
    torch.save({"encoder.weight": Evil()}, folder / "weights.pt")
    (folder / "config.json").write_text(json.dumps(lewm_config()))
    with pytest.raises(Exception, match="weights_only|Weights only"):
        load_pretrained("evil")
    with pytest.raises(Exception, match="weights_only|Weights only"):
        probes.load_probe(torch.nn.Linear(1, 1), "x", folder / "weights.pt")
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("name", ["weights.pt", "run.ckpt"])
def test_every_changed_bit_of_an_archive_is_refused_or_harmless(tmp_path, name):
    torch.save({"weight": torch.arange(300.0)}, tmp_path / name)
    content, file = (tmp_path / name).read_bytes(), tmp_path / f"changed-{name}"
    begin = zipfile.ZipFile(tmp_path / name).start_dir
    for position in (*range(0, 64), *range(begin, len(content))):
        for bit in range(8):
            changed = bytearray(content)
            changed[position] ^= 1 << bit
            file.write_bytes(changed)
            try:
                found = _weights.read_state_dict(file)
            except RuntimeError as error:
                assert str(file) in str(error), (position, bit)
            else:
                assert torch.equal(found["weight"], torch.arange(300.0)), (position, bit)


@pytest.mark.parametrize(
    ("name", "content", "kind"),
    [
        ("config.json", b"[" * 100_000, ValueError),
        ("config.json", b"[" * 900 + b"]" * 900, ValueError),
        ("config.json", b"{", ValueError),
        ("config.json", b'{"\xff": 1}', ValueError),
        ("config.json", b'{"_target_": "torch.nn.Linear", "in_features": "4", "out_features": 3}', ValueError),
        ("config.json", b'{"_target_": "torch.nn.Linear", "in_features": -4, "out_features": 3}', ValueError),
        ("config.json", b'{"_target_": "torch.nn.Linear"}', ValueError),
        ("config.json", b'{"_target_": "os.system"}', ValueError),
        ("weights.pt", b"", RuntimeError),
        ("weights.pt", b"not weights", RuntimeError),
        ("weights.pt", b"PK\x03\x04", RuntimeError),
    ],
)
def test_errors_of_damaged_files_name_the_file(tmp_path, name, content, kind):
    config = {"_target_": "torch.nn.Linear", "in_features": 4, "out_features": 3}
    save_pretrained(torch.nn.Linear(4, 3), "linear", config, cache_dir=tmp_path)
    file = tmp_path / "checkpoints" / "linear" / name
    file.write_bytes(content)
    with warnings.catch_warnings(), pytest.raises(kind) as raised:
        # Changed configurations are warned of.
        warnings.simplefilter("ignore")
        load_pretrained(file.parent)
    assert str(raised.value).startswith(f"{file}: ") and not isinstance(raised.value, RecursionError)


@pytest.mark.parametrize(
    "header",
    [
        b"{",
        b"[]",
        b"\xff\xff",
        b"[" * 100_000,
        b'{"x": 1}',
        b'{"x": {}}',
        b'{"x": {"dtype": [], "shape": [1], "data_offsets": [0, 4]}}',
        b'{"x": {"dtype": "F32", "shape": [3], "data_offsets": [0, 4]}}',
        b'{"x": {"dtype": "F32", "shape": "3", "data_offsets": [0, 4]}}',
        b'{"x": {"dtype": "F32", "shape": [1], "data_offsets": [0, 3]}}',
        b'{"x": {"dtype": "F32", "shape": [1], "data_offsets": [0.0, 4]}}',
        b'{"x": {"dtype": "F32", "shape": [100000000000000000000], "data_offsets": [0, 4]}}',
        b'{"__metadata__": 3}',
        b'{"__metadata__": {"swm_capsule": "{"}}',
    ],
)
def test_errors_of_damaged_safetensors_name_the_file(tmp_path, header):
    file = tmp_path / "weights.safetensors"
    file.write_bytes(len(header).to_bytes(8, "little") + header + bytes(4))
    is_capsule = b"swm_capsule" in header
    with pytest.raises(RuntimeError) as raised:
        _weights.read_capsule(file) if is_capsule else _weights.read_state_dict(file)
    assert str(raised.value).startswith(f"{file}: ") and not isinstance(raised.value, RecursionError)


def test_lack_of_memory_is_not_called_damage(home, monkeypatch):
    save_pretrained(torch.nn.Linear(4, 3), "linear", {"_target_": "torch.nn.Linear", "in_features": 4, "out_features": 3})

    def fail(*_, **__):
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 4 bytes")

    for module, name in ((torch, "load"), (torch.nn.init, "kaiming_uniform_")):
        with monkeypatch.context() as changed, pytest.raises(RuntimeError, match="^DefaultCPUAllocator"):
            changed.setattr(module, name, fail)
            load_pretrained("linear")


def test_other_objects_in_weights_are_named(home):
    folder = home / "checkpoints/run"
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps({"_target_": "torch.nn.Linear", "in_features": 2, "out_features": 2}))
    given = {"state_dict": torch.nn.Linear(2, 2).state_dict(), "hyper_parameters": {"root": PurePosixPath("data")}}
    torch.save(given, folder / "last.ckpt")
    with pytest.raises(RuntimeError, match="last.ckpt: it holds objects of 'pathlib.PurePosixPath'.*swm checkpoints import"):
        load_pretrained(folder / "last.ckpt")


def test_weights_with_nan_are_refused(home):
    config = {"_target_": "torch.nn.Linear", "in_features": 2, "out_features": 2}
    model = torch.nn.Linear(2, 2)
    for bad, match in ((float("inf"), None), (float("nan"), "'bias' has NaN")):
        torch.nn.init.constant_(model.bias, bad)
        save_pretrained(model, "mine", config)
        with contextlib.nullcontext() if match is None else pytest.raises(RuntimeError, match=match):
            load_pretrained("mine")


def test_extra_states_that_are_no_tensors_are_not_saved(home):
    class Extra(torch.nn.Linear):
        def get_extra_state(self):
            return {"step": 3}

        def set_extra_state(self, state):
            pass

    with pytest.raises(ValueError, match="'_extra_state' of its state dict is no tensor"):
        save_pretrained(Extra(2, 2), "mine", {"_target_": "torch.nn.Linear"})
    assert not home.exists()


def test_probes_are_kept_with_the_model(tmp_path):
    model, probe = torch.nn.Linear(2, 2), torch.nn.Linear(2, 1)
    assert probes.get_probe(model, "angle") is None
    probes.attach_probe(model, "angle", probe)
    assert probes.get_probe(model, "angle") is probe and any("angle" in name for name in model.state_dict())
    torch.save(torch.nn.Linear(2, 1).state_dict(), tmp_path / "probe.pt")
    before = probe.weight.clone()
    probes.load_probe(model, "angle", tmp_path / "probe.pt")
    assert not torch.equal(before, probe.weight)
    with pytest.raises(ValueError, match="no probe 'speed'"):
        probes.load_probe(model, "speed", tmp_path / "probe.pt")
    with pytest.raises(TypeError, match="Module"):
        probes.attach_probe(model, "angle", lambda x: x)


def test_a_subclass_is_planned_with():
    from stable_worldmodel.wm._build import build

    class NearStart(swm.wm.LeWM):
        def criterion(self, info_dict, action_candidates=None):
            return action_candidates.square().sum((2, 3)) if action_candidates is not None else super().criterion(info_dict)

    torch.manual_seed(0)
    config = lewm_config()
    parts = {name: build(part) for name, part in config.items() if name != "_target_"}
    parts["encoder"] = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d((1, 2)), torch.nn.Flatten())
    parts["encoder"].takes_frames = True
    solver = swm.planning.CEMSolver(NearStart(**parts).eval(), num_samples=64, n_steps=12, topk=8)
    world = swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(16, 16), max_episode_steps=4)
    world.set_policy(swm.policy.WorldModelPolicy(solver, swm.PlanConfig(3, 1)))
    world.reset(seed=0)
    world.step()
    assert np.abs(world.infos["action"]).max() < 0.1


def test_load_waits_for_a_save_and_skips_what_is_no_file(home):
    config = {"_target_": "torch.nn.Linear", "in_features": 3, "out_features": 3}
    save_pretrained(torch.nn.Linear(3, 3), "mine", config)
    folder = home / "checkpoints/mine"
    os.mkfifo(folder / "zz.pt")
    loaded = []
    with _files.locked(folder, exclusive=True):
        other = threading.Thread(target=lambda: loaded.append(load_pretrained("mine")))
        other.start()
        other.join(0.3)
        assert not loaded
    other.join()
    assert loaded[0].in_features == 3


@pytest.mark.parametrize("name", ["weights.pt", "weights.safetensors"])
def test_sparse_weights_take_no_memory(tmp_path, name):
    file = tmp_path / name
    with file.open("wb") as opened:
        opened.write(b"PK")
        opened.truncate(1 << 33)
    with pytest.raises(RuntimeError, match="sparse"):
        _weights.read_state_dict(file)
