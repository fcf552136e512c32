"""Files of strangers and of the user: a run executes no code of a folder, and replaces no file of the user."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import printed, swm

from stable_worldmodel.ray import cells
from stable_worldmodel.ray.driver import RunRefused, begin
from stable_worldmodel.ray.folder import Folder, Outputs, TrainingState

#: A module that leaves a file when it is imported.
MODULE = "import pathlib; pathlib.Path(__file__).with_name('imported').touch(); raise SystemExit(3)"
MODULES = ("json", "socket", "importlib", "ctypes", "tempfile", "subprocess", "ray", "stable_worldmodel", "numpy")


def evil(folder):
    """A folder with modules of the names that a run imports."""
    folder.mkdir()
    for name in MODULES:
        (folder / f"{name}.py").write_text(MODULE)
    return folder


def test_a_run_imports_no_module_of_the_current_folder(cluster, tmp_path):
    here = evil(tmp_path / "here")
    # As the program `swm`, whose path has no current folder.
    start = "import sys; del sys.path[0]; from stable_worldmodel.__main__ import main; main()"
    arguments = ["collect", "swm/TwoRoom-v1", "-o", tmp_path / "a.lance", "--episodes", 2, "--no-pixels", "--on", "ray"]
    done = subprocess.run([sys.executable, "-c", start, *map(str, arguments)], cwd=here, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert printed("inspect", tmp_path / "a.lance")["episodes"] == 2
    assert not (here / "imported").exists()


def test_a_cluster_that_a_run_starts_imports_no_module_of_the_current_folder(tmp_path, monkeypatch):
    here = evil(tmp_path / "here")
    program = (
        "import sys; del sys.path[0]\n"
        "import ray; from stable_worldmodel.ray.local import connect; connect()\n"
        "print(*ray.get(ray.remote(lambda: sys.path).remote()), sep='\\n')"
    )
    without = {name: value for name, value in os.environ.items() if name != "RAY_ADDRESS"}
    done = subprocess.run([sys.executable, "-c", program], cwd=here, env=without, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    paths = done.stdout.splitlines()
    assert paths and str(here) not in paths and not (here / "imported").exists()


@pytest.mark.parametrize(
    "name", ["../evil", "/etc/evil", "checkpoint/../../evil", "a/b", "checkpoint//x", "..", "", 5, "checkpoint/a\\b"]
)
def test_a_state_writes_only_files_of_a_training(tmp_path, name):
    state = Folder(str(tmp_path / "state"))
    state.write("0/evil", b"evil")
    state.write_json("latest.json", {"place": 0, "files": ["run.json", name]})
    local = tmp_path / "node" / "run"
    with pytest.raises(RuntimeError, match="outside of a folder|no file of a training"):
        TrainingState(state.root, local).restore()
    assert not local.exists()


@pytest.mark.parametrize("place", ["../../x", 2, None, "0"])
def test_a_state_is_in_one_of_two_places(tmp_path, place):
    state = Folder(str(tmp_path / "state"))
    state.write_json("latest.json", {"place": place, "files": []})
    with pytest.raises(RuntimeError, match="damaged"):
        TrainingState(state.root, tmp_path / "run").restore()


def test_a_request_of_a_folder_needs_trust(tmp_path):
    run = [sys.executable, "-m", "stable_worldmodel.ray", str(tmp_path)]
    (tmp_path / "request.json").write_text(json.dumps({"arguments": ["collect", "evil_mod:X-v0"]}))
    done = subprocess.run(run, capture_output=True, text=True)
    assert done.returncode == 2 and "--trust" in done.stderr, done.stderr
    (tmp_path / "request.json").write_text("[1]")
    done = subprocess.run([*run, "--trust"], capture_output=True, text=True)
    assert done.returncode == 1 and "request.json is damaged" in done.stderr and "Traceback" not in done.stderr, done.stderr


@pytest.mark.parametrize("name", ["../x", "/x", "a/b", "", ".", "..", 5])
def test_cells_have_plain_names(name):
    for request in ({"kind": "train", "cells": {"runs": [{"name": name}]}}, {"kind": "study", "cells": {"ids": [name]}}):
        with pytest.raises(ValueError, match="no name of a file"):
            cells.stages(request)


def test_a_folder_with_records_and_no_request_is_refused(tmp_path):
    folder = Folder(str(tmp_path / "run"))
    folder.write_json("cells/000000.json", {"id": "x"})
    with pytest.raises(RunRefused, match="has files and no request.json"):
        begin(folder, {"kind": "collect"})
    assert folder.list() == ["cells/000000.json"]


def test_a_run_that_continues_takes_the_folder_of_its_last_command(tmp_path):
    folder = Folder(str(tmp_path / "run"))
    begin(folder, {"kind": "collect", "directory": "/stranger"})
    begin(folder, {"kind": "collect", "directory": "/mine"})
    assert folder.read_json("request.json")["directory"] == "/mine"


def test_outputs_replace_files_of_their_run_only(tmp_path):
    (tmp_path / "out").mkdir()
    source = tmp_path / "out" / "results.json"
    target, records = Folder(str(tmp_path / "target")), Folder(str(tmp_path / "run"))
    for content in ("first", "second", "second"):  # later attempts of the cell
        source.write_text(content)
        Outputs(records, "join").upload(tmp_path / "out", target)
        assert target.read("results.json") == content.encode()
    for other in ("mine", '{"title": "T", "cells": []}'):
        target.write("results.json", other.encode())
        with pytest.raises(RuntimeError, match="exists and was not written by this run"):
            Outputs(records, "join").upload(tmp_path / "out", target)
        assert target.read("results.json") == other.encode()
    # A study replaces its own file.
    study = tmp_path / "study.json"
    study.write_text("{}")
    own = Folder(str(tmp_path / "study" / "study.json"))
    own.write("", b'{"title": "T", "cells": []}')
    with pytest.raises(RuntimeError, match="was not written"):
        Outputs(records, "study", "other").upload(study, own)
    Outputs(records, "study", "T").upload(study, own)
    assert own.read("") == b"{}"


def test_files_of_the_user_in_the_output_are_refused_before_the_work(rooms, tmp_path):
    path, *_ = rooms
    user = tmp_path / "user"
    (user / "run" / "checkpoint").mkdir(parents=True)
    for name in ("results.json", "study.json", "run/train.jsonl", "run/checkpoint/weights.safetensors"):
        (user / name).write_text("mine")
    (tmp_path / "study.toml").write_text(
        'title = "T"\nquestion = "q?"\n[defaults]\nenv = "swm/TwoRoom-v1"\nepisodes = 1\nno-pixels = true\n'
        '[[condition]]\nname = "c"\n[[policy]]\nname = "random"\npolicy = "random"\n'
    )
    (tmp_path / "link").symlink_to(user)
    for arguments in (
        ["eval", "random", "--env", "swm/TwoRoom-v1", "--no-pixels", "--episodes", 1, "--budget", 2],
        ["study", "run", tmp_path / "study.toml"],
        ["train", "lewm", "--data", path, "--preset", "tiny", "schedule.steps=1"],
    ):
        for output in (user, tmp_path / "link"):
            done = swm(*arguments, "-o", output, "--on", "ray", SWM_RAY_PYTHON=sys.executable)
            assert done.returncode == 2 and "was not written by this" in done.stderr, done.stderr
    assert all(path.read_text() == "mine" for path in user.rglob("*") if path.is_file())
    assert not Path(f"{user}.ray").exists()
