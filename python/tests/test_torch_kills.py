"""Tests of trainings in torch that kills, refusals and full disks end, and of those that continue them."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

torch = pytest.importorskip("torch")
torch.set_num_threads(1)

import stable_worldmodel as swm  # noqa: E402
from stable_worldmodel.train import Options, Trainer, train  # noqa: E402
from stable_worldmodel.wm._weights import read_safetensors  # noqa: E402
from stable_worldmodel.wm.utils import load_pretrained  # noqa: E402

#: A training of seconds.
SHORT = ["data.batch_size=10", "schedule.steps=6", "schedule.warmup=2", "log_every=2", "shards=1"]


def torch_train(family, rooms, out, settings, **options):
    return train(family, rooms, settings=[*settings], out=str(out), preset="tiny", device="cpu", **options)


def weights(run):
    return read_safetensors(Path(run) / "checkpoint/weights.safetensors")


def log_of(run):
    return [json.loads(line) for line in (Path(run) / "train.jsonl").read_text().splitlines()]


def test_kills_while_a_checkpoint_is_written_are_continued(rooms, tmp_path):
    options = {"data": rooms, "preset": "tiny", "device": "cpu", "settings": SHORT}
    torch_train("gcbc", rooms, tmp_path / "whole", SHORT)
    # Between the two renamings: the old checkpoint, and a new one.
    Trainer(Options("gcbc", out=str(tmp_path / "swap"), **options)).train(until=2)
    (tmp_path / "swap/checkpoint").rename(tmp_path / "swap/.checkpoint.old")
    shutil.copytree(tmp_path / "whole/checkpoint", tmp_path / "swap/.checkpoint.new")
    assert load_pretrained(tmp_path / "swap").stored.config["seed"] == 0
    with pytest.raises(ValueError, match="resume=True"):
        torch_train("gcbc", rooms, tmp_path / "swap", SHORT)
    # While it writes the first one, which has no manifest.
    for name in ("first", "again"):
        (tmp_path / name).mkdir()
        shutil.copytree(tmp_path / "whole/checkpoint", tmp_path / name / ".checkpoint.new")
        (tmp_path / name / ".checkpoint.new/manifest.json").unlink()
    # Files of the user with such names stay.
    (tmp_path / "mine/.checkpoint.new").mkdir(parents=True)
    (tmp_path / "mine/.checkpoint.new/weights.safetensors").write_text("mine")
    with pytest.raises(ValueError, match="move them away"):
        torch_train("gcbc", rooms, tmp_path / "mine", SHORT)
    for name, resume in (("swap", True), ("first", True), ("again", False)):
        trainer = Trainer(Options("gcbc", out=str(tmp_path / name), resume=resume, **options))
        assert trainer.step == (2 if name == "swap" else 0)
        trainer.train()
        found, expected = weights(tmp_path / name), weights(tmp_path / "whole")
        assert all(torch.equal(found[key], value) for key, value in expected.items()) and found.keys() == expected.keys()
        assert {path.name for path in (tmp_path / name).iterdir()} == {"checkpoint", "run.json", "train.jsonl"}


def test_a_training_that_is_killed_before_its_first_step_is_continued_by_its_folder(rooms, tmp_path):
    torch_train("gcbc", rooms, tmp_path / "whole", SHORT)
    Trainer(Options("gcbc", rooms, out=str(tmp_path / "run"), preset="tiny", device="cpu", settings=SHORT))
    assert {path.name for path in (tmp_path / "run").iterdir()} == {"checkpoint", "run.json"}
    record = json.loads((tmp_path / "run/run.json").read_text())
    assert [run["program"] for run in record["commands"]] == ["stable_worldmodel.train (torch)"]
    # A kill before the first checkpoint leaves the record only.
    (tmp_path / "early").mkdir()
    shutil.copy(tmp_path / "run/run.json", tmp_path / "early/run.json")
    for name in ("run", "early"):
        swm.wm.engine._command(["swm", "train", "--output", str(tmp_path / name), "--resume"])
        assert [row["step"] for row in log_of(tmp_path / name)] == [2, 4, 6]
    # A training that is refused leaves no record.
    with pytest.raises(ValueError, match="data.batch_size"):
        torch_train("gcbc", rooms, tmp_path / "refused", [*SHORT[1:], "data.batch_size=0"])
    assert not (tmp_path / "refused/run.json").exists()
    with pytest.raises(ValueError, match="resume=True"):
        torch_train("gcbc", rooms, tmp_path / "whole", [*SHORT, "seed=1"])
    assert "seed=1" not in (tmp_path / "whole/run.json").read_text()


def test_the_log_of_a_continued_training_is_that_of_a_whole_one(rooms, tmp_path):
    settings = [setting for setting in SHORT if not setting.startswith("log_every")] + ["log_every=4"]
    options = {"data": rooms, "preset": "tiny", "settings": settings, "device": "cpu"}
    torch_train("gcbc", rooms, tmp_path / "whole", settings)
    Trainer(Options("gcbc", out=str(tmp_path / "run"), **options)).train(until=3)
    Trainer(Options("gcbc", out=str(tmp_path / "run"), resume=True, **options)).train()
    times = {"clips_per_second", "data_wait", "seconds"}
    without_times = [
        [{k: v for k, v in row.items() if k not in times} for row in log_of(tmp_path / r)] for r in ("run", "whole")
    ]
    assert without_times[0] == without_times[1] and [row["step"] for row in without_times[0]] == [4, 6]
    assert "window" not in json.loads((tmp_path / "run/checkpoint/state.json").read_text())


def test_a_refused_training_is_not_recorded(rooms, tmp_path):
    options = {"data": rooms, "preset": "tiny", "settings": SHORT, "device": "cpu", "out": str(tmp_path / "run")}
    Trainer(Options("gcbc", **options)).train(until=2)
    first, second = (Trainer(Options("gcbc", resume=True, **options)) for _ in range(2))
    first.train(until=4)
    with pytest.raises(ValueError, match="another process has trained here, from step 2 to step 4"):
        second.train()
    assert len(json.loads((tmp_path / "run/run.json").read_text())["commands"]) == 2
    assert json.loads((tmp_path / "run/checkpoint/state.json").read_text())["step"] == 4


def test_errors_escape_what_files_say(rooms, tmp_path):
    torch_train("gcbc", rooms, tmp_path / "run", SHORT)
    path = tmp_path / "run/checkpoint/manifest.json"
    manifest = json.loads(path.read_text())
    manifest["config"]["\x1b]0;title\x07"] = manifest["config"].pop("seed")
    path.write_text(json.dumps(manifest))
    with pytest.raises(ValueError, match="another configuration") as error:
        torch_train("gcbc", rooms, tmp_path / "run", SHORT, resume=True)
    assert "\x1b" not in str(error.value) and "\\u{1b}]0;title" in str(error.value)


def test_a_closed_or_full_output_is_an_error_without_a_traceback(tmp_path):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    for redirection, message in ((">&-", "standard output is closed"), (">/dev/full", "standard output: No space left")):
        line = f"{sys.executable} -m stable_worldmodel.train {redirection}"
        done = subprocess.run(line, shell=True, stderr=subprocess.PIPE, text=True, env=environment, cwd=tmp_path)
        assert done.returncode == 1 and message in done.stderr and "Traceback" not in done.stderr, done.stderr
