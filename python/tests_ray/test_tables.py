"""Studies of tables on a cluster have the rows of one process."""

import re

import pytest
import ray
from conftest import files_of, printed, swm

import stable_worldmodel.ray as swm_ray
from stable_worldmodel.ray.folder import Folder, TrainingState

#: A study of each kind whose values do not depend on the machine, and the number of its cells on a cluster.
TABLES = {
    "factors": (
        1,
        'kind = "factors"\ntitle = "T"\nquestion = "q?"\n[published]\n"swm/TwoRoom-v1" = [1, 2]\n"other" = [3, 4]\n',
    ),
    "online": (
        3,
        """
kind = "online"
title = "Returns"
question = "Which returns are reached?"

[defaults]
envs = ["swm/PendulumControl-v1"]
families = ["sac"]
preset = "tiny"
seeds = [0, 1]
steps = 20
warmup = 20
episodes = 1
max-steps = 20
""",
    ),
    "drift": (
        6,
        """
kind = "drift"
title = "Drift"
question = "Does the actor drift?"

[defaults]
env = "swm/PushT-v1"
dataset = "few-states"
train = ["model.encoding=[{column=\\"state\\",latent=16}]"]
steps = 8
episodes = 1
max-steps = 10
frames = 50

[[collect]]
name = "few-states"
env = "swm/PushT-v1"
policy = "expert"
episodes = 20
max-steps = 20
no-pixels = true
""",
    ),
}

DATA = """
kind = "data"
title = "Formats"
question = "Which one is fast?"

[defaults]
envs = ["swm/TwoRoom-v1"]
layouts = ["lance, jpeg", "hdf5"]
remote-layouts = ["hdf5"]
episodes = 3
steps = 30
size = 16
batch = 4
repeats = 1
seconds = 0.01
"""


def lasting(files):
    """Files without the logs of a training, which have times."""
    return {name: content for name, content in files.items() if not re.search(r"/(train\.jsonl|events\.[^/]+)$", name)}


@pytest.mark.parametrize("kind", TABLES)
def test_a_table_has_the_rows_of_one_process(kind, cluster, s3, tmp_path):
    cells, text = TABLES[kind]
    (tmp_path / "table.toml").write_text(text)
    one, many = tmp_path / "one", Folder(f"{s3}/table-{kind}")
    # Another home, so that each collects its datasets and trains its models itself.
    home = {"STABLEWM_HOME": str(tmp_path / "home")}
    done = swm("study", "run", tmp_path / "table.toml", "-o", one, "--trust", **home)
    assert done.returncode == 0, done.stderr
    summary = ray.get(swm_ray.study(tmp_path / "table.toml", many.root, trust=True))
    assert summary["cells"] == cells and swm_ray.progress(summary["folder"]) == {"done": cells, "cells": cells}
    rows = Folder(str(one)).read_json("study.json")["cells"]
    expected = files_of(one)
    assert sum(name.startswith("cells/") for name in expected) == len(rows) > 1
    assert lasting({name: many.read(name) for name in many.list()}) == lasting(expected)
    assert any(name.endswith("weights.safetensors") for name in expected) == (kind == "drift")
    # A folder of rows is another's word for what they load.
    done = swm("study", "resume", one)
    assert done.returncode == 2 and "--trust" in done.stderr, done.stderr


def test_a_model_that_rows_share_continues_from_its_last_checkpoint(cluster, s3, tmp_path):
    (tmp_path / "table.toml").write_text(TABLES["drift"][1])
    one, many = tmp_path / "one", Folder(f"{s3}/table-continued")
    given = ["study", "run", tmp_path / "table.toml", "--trust"]
    assert swm(*given, "-o", one).returncode == 0
    request = printed(*given, "-o", many.root, "--on", "ray", "--print-request")
    folder = Folder(request["folder"])
    folder.write_json("request.json", request)
    (model,) = (one / "models").iterdir()
    assert TrainingState(folder.at(f"state/{request['cells']['model']}"), model).store()
    assert ray.get(swm_ray.study(tmp_path / "table.toml", many.root, trust=True))["ran"] == 6
    # It was done already: its log, which has times, has no line of another training.
    log = f"models/{model.name}/train.jsonl"
    assert many.read(log) == (one / log).read_bytes() != b""
    assert lasting({name: many.read(name) for name in many.list()}) == lasting(files_of(one))


def test_speeds_are_those_of_one_node(cluster, s3, tmp_path):
    (tmp_path / "data.toml").write_text(DATA)
    many = Folder(f"{s3}/table-data")
    command = ["study", "run", tmp_path / "data.toml", "--threads", 1]
    found = printed(*command, "-o", tmp_path / "one")
    summary = ray.get(swm_ray.study(tmp_path / "data.toml", many.root))
    assert summary["cells"] == 1
    many.download(tmp_path / "many")
    rows = printed("study", "status", tmp_path / "many")["rows"]
    # The object store is not named, so its row stays empty. Of the others, only the speeds differ.
    assert [sorted(row["values"][:4], key=str)[0] is None for row in rows] == [False, False, True]
    assert [without_speeds(row) for row in rows] == [without_speeds(row) for row in found["rows"]]
    assert all(row["machine"].endswith("1 threads") for row in rows[:2])
    assert many.read("study.json") == (tmp_path / "one" / "study.json").read_bytes()


def without_speeds(row):
    """A row of the kind `data` with the size of its dataset (a Lance dataset has times) and the published speeds."""
    size, *published = row["values"][3:]
    return row | {"values": [size and pytest.approx(size, rel=1e-3), *published]}
