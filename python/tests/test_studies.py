"""Tests of studies: running, reading and exporting."""

import csv
import io
import json

import numpy as np
import pytest

import stable_worldmodel as swm
from stable_worldmodel import _engine, _options

STUDY = """
title = "Colours"
question = "Does the planner see colours?"
[defaults]
env = "swm/TwoRoom-v1"
episodes = 3
budget = 20
no-pixels = true
[[condition]]
name = "in distribution"
[[condition]]
name = "hue {hue}"
pin = { "agent.color" = "hsv({hue},1,1)" }
each = { hue = [0, 120] }
[[policy]]
name = "planner"
policy = "expert"
"""


def test_a_study_runs_continues_and_is_read(tmp_path):
    (tmp_path / "study.toml").write_text(STUDY)
    study = swm.studies.run(tmp_path / "study.toml", tmp_path / "out", episodes=4, seed=[0, 1])
    assert study.is_done and study.title == "Colours" and len(study.rows) == 6
    assert {row["variables.hue"] for row in study.gaps} == {"0", "120"} and len(study.gaps) == 4
    rates, gaps = study.column("success.rate"), study.column("gap.difference")
    assert rates.dtype == np.float64 and np.isfinite(rates).all() and np.isnan(gaps).sum() == 2
    assert set(study.column("policy")) == {"planner"} and study.column("success.n").max() <= 4
    assert len(study.families) == 2 and study.families[0]["comparisons"] == 2
    table = list(csv.DictReader(io.StringIO(study.export("csv"))))
    assert [float(row["rate"]) for row in table] == rates.tolist()
    files = {path: path.read_bytes() for path in (tmp_path / "out" / "cells").iterdir()}
    assert swm.studies.run(tmp_path / "study.toml", tmp_path / "out", episodes=4, seed=[0, 1]) == study
    assert {path: path.read_bytes() for path in (tmp_path / "out" / "cells").iterdir()} == files
    assert study.report(tmp_path / "page").read_text().startswith("<!DOCTYPE html>")
    with pytest.raises(KeyError, match=r"success\.rate"):
        study.column("success")


def test_a_rule_ends_a_study(tmp_path):
    (tmp_path / "study.toml").write_text(STUDY)
    study = swm.studies.run(tmp_path / "study.toml", tmp_path / "out", until="ci=49", episodes=40)
    assert study.is_done and study.results["until"] == "ci=49"
    # The first stage has ten starts, which are enough for an interval this wide.
    assert study.column("success.n").max() <= 10
    with pytest.raises(ValueError, match=r"--until ci=49"):
        swm.studies.run(tmp_path / "study.toml", tmp_path / "out", episodes=40)
    with pytest.raises(ValueError, match=r"'width=5' is no rule"):
        swm.studies.run(tmp_path / "study.toml", tmp_path / "other", until="width=5")


def test_a_study_of_another_kind_has_its_own_columns(tmp_path):
    study = swm.studies.run("paper/factors-per-env", tmp_path / "factors")
    ids = list(study.column("environment"))
    native = study.column("native")
    factors = json.loads(_engine.spec("swm/TwoRoom-v1"))["variation"]
    assert native[ids.index("swm/TwoRoom-v1")] == len(factors)
    assert study.export("markdown").startswith("| environment | native, factors |")


def test_a_study_runs_without_output_where_none_is_wanted(tmp_path, capfd):
    (tmp_path / "study.toml").write_text(STUDY)
    for shown in (True, False):
        swm.studies.run(tmp_path / "study.toml", tmp_path / str(shown), episodes=2, progress=shown)
        assert bool("".join(capfd.readouterr())) == shown
    with pytest.raises(ValueError, match="'width=5' is no rule"):
        swm.studies.run(tmp_path / "study.toml", tmp_path / "other", until="width=5", progress=False)


def test_settings_of_numpy_are_those_of_python(tmp_path):
    (tmp_path / "study.toml").write_text(STUDY)
    study = swm.studies.run(tmp_path / "study.toml", tmp_path / "out", episodes=np.int64(2), seed=np.array([0, 1]))
    assert len(study.rows) == 6 and study.column("success.n").max() <= 2


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (["😀", "a"], '["😀", "a"]'),
        ({"é": {"b": 'say "x"'}}, '{"é" = {"b" = "say \\"x\\""}}'),
        (np.float32(3e-4), "0.0003"),
        ([np.array(3e-4, np.float32), np.float64(0.1)], "[0.0003, 0.1]"),
        (np.array([[0.9, 0.95], [1, 2]], np.float32), "[[0.9, 0.95], [1.0, 2.0]]"),
        (np.array([True, False]), "[true, false]"),
        (np.array(["é"]), '["é"]'),
    ],
)
def test_settings_are_written_as_toml(given, text):
    assert _options.setting(given) == text


@pytest.mark.parametrize(("given", "name"), [(None, "optim.lr"), ([1, None], "optim.lr"), ({"a": {"b": None}}, "optim.lr.a.b")])
def test_a_setting_is_not_none(given, name):
    with pytest.raises(TypeError, match=f"{name}: None; expected a value"):
        _options.setting(given, "optim.lr")


def test_errors_name_the_study_and_the_setting(tmp_path):
    assert any(study["name"] == "two-room/colour-wheel" for study in swm.studies.available())
    with pytest.raises(ValueError, match="paper/factors"):
        swm.studies.run("paper/factor", tmp_path / "out")
    with pytest.raises(ValueError, match="csv"):
        swm.studies.Study(tmp_path, {}).export("cvs")
    with pytest.raises(FileNotFoundError):
        swm.studies.read(tmp_path / "nowhere")
