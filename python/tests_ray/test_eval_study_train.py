"""Evaluations, studies and trainings on a cluster have the results of one process."""

import json

import pytest
import ray
from conftest import content_hash, files_of, printed, remove, swm

import stable_worldmodel as swm_package
import stable_worldmodel.ray as swm_ray
from stable_worldmodel.ray.folder import Folder, TrainingState

#: A small evaluation under three conditions.
EVALUATION = {"episodes": 4, "envs": 4, "budget": 20, "image": 32, "shift": ["agent.color", "agent.color=0,0,255"], "seed": 3}

STUDY = """
title = "Colours"
question = "Does the colour of the agent matter?"

[defaults]
env = "swm/TwoRoom-v1"
episodes = 3
budget = 15
image = 32

[[condition]]
name = "in distribution"

[[condition]]
name = "blue"
pin = { "agent.color" = [0, 0, 255] }

[[policy]]
name = "expert"
policy = "expert"
"""


def without_times(results):
    """Results without what differs between equal evaluations."""
    for run in results["runs"]:
        run.pop("timing")
    return results


def videos_of(folder):
    """The videos of an evaluation and their posters: their bytes by name."""
    return {name: folder.read(f"videos/{name}") for name in folder.list("videos")}


def test_an_evaluation_has_the_results_and_videos_of_one_process(cluster, s3, tmp_path):
    flags = [part for name, value in EVALUATION.items() for part in flag(name, value)]
    printed("eval", "expert", "no-op", "--env", "swm/TwoRoom-v1", "-o", tmp_path / "one", *flags)
    output = Folder(f"{s3}/colours")
    done = swm_ray.evaluate(["expert", "no-op"], output.root, env="swm/TwoRoom-v1", **EVALUATION)
    assert ray.get(done)["cells"] == 4
    one = json.loads((tmp_path / "one" / "results.json").read_text())
    assert without_times(output.read_json("results.json")) == without_times(one)
    expected = videos_of(Folder(str(tmp_path / "one")))
    names = {name for run in one["runs"] for name in run["videos"]}
    assert names and {f"videos/{name}" for name in expected} == names | {name.replace(".mp4", ".png") for name in names}
    assert videos_of(output) == expected
    # The record has the command of the user, not that of the last cell.
    command = output.read_json("run.json")["commands"][0]["command"]
    assert command[:4] == ["swm", "eval", "expert", "no-op"] and "--join" not in command
    # No videos on request.
    done = swm_ray.evaluate("no-op", f"{s3}/plain", env="swm/TwoRoom-v1", episodes=1, budget=2, image=32, videos=0)
    assert ray.get(done)["cells"] == 2 and videos_of(Folder(f"{s3}/plain")) == {}


def test_an_evaluation_has_the_traces_of_one_process(cluster, s3, tmp_path):
    options = {"episodes": 2, "envs": 2, "budget": 6, "image": 32, "seed": 3, "shift": "agent.color=0,0,255", "videos": 0}
    options |= {"solver": "cem,samples=8,iterations=2,elites=4", "horizon": 2}
    flags = [part for name, value in options.items() for part in flag(name, value)]
    printed("eval", "simulator", "--env", "swm/TwoRoom-v1", "-o", tmp_path / "one", "--trace", *flags)
    output = Folder(f"{s3}/traced")
    assert ray.get(swm_ray.evaluate("simulator", output.root, env="swm/TwoRoom-v1", trace=True, **options))["cells"] == 3
    one = Folder(str(tmp_path / "one"))
    assert without_times(output.read_json("results.json")) == without_times(one.read_json("results.json"))
    found, expected = ([untimed(plan) for plan in folder.read_json("traces.json")] for folder in (output, one))
    assert found == expected and len(found) > 2
    # Other files of this name are refused before the work.
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "traces.json").write_text("mine")
    done = swm("eval", "simulator", "--env", "swm/TwoRoom-v1", "--trace", "-o", tmp_path / "mine", "--on", "ray", *flags)
    assert done.returncode == 2 and "traces.json: exists and was not written by this run" in done.stderr, done.stderr


def untimed(plan):
    """A traced plan without its times."""
    return {key: value for key, value in plan.items() if not key.endswith("seconds")}


@pytest.mark.parametrize(
    ("rule", "policies", "episodes"),
    [("ci=30", ["expert", "no-op"], 60), ("decided", ["expert", "no-op"], 60), ("ci=1", ["no-op"], 25)],
)
def test_an_evaluation_that_its_results_end_has_those_of_one_process(rule, policies, episodes, cluster, s3, tmp_path):
    options = {"until": rule, "episodes": episodes, "envs": 5, "budget": 12, "image": 32, "videos": 2, "seed": 4}
    options |= {"shift": "agent.color=0,0,255"}
    flags = [part for name, value in options.items() for part in flag(name, value)]
    printed("eval", *policies, "--env", "swm/TwoRoom-v1", "-o", tmp_path / "one", *flags)
    output = Folder(f"{s3}/until-{rule}")
    summary = ray.get(swm_ray.evaluate(policies, output.root, env="swm/TwoRoom-v1", **options))
    one = Folder(str(tmp_path / "one"))
    expected = one.read_json("results.json")
    assert without_times(output.read_json("results.json")) == without_times(expected)
    assert videos_of(output) == videos_of(one) != {}
    stages = Folder(summary["folder"]).list("parts/stages")
    played = len(expected["runs"][0]["episodes"])
    assert max(int(name.split("/")[0]) for name in stages) == played
    assert summary["cells"] == 3 * (len(stages) // 2) + 1
    assert swm_ray.progress(summary["folder"]) == {"done": summary["cells"], "cells": summary["cells"]}
    # The same call finds everything done.
    assert ray.get(swm_ray.evaluate(policies, output.root, env="swm/TwoRoom-v1", **options))["ran"] == 0


def test_rules_that_cannot_end_an_evaluation_are_refused_before_the_work(tmp_path):
    given = ["eval", "random", "--env", "swm/TwoRoom-v1", "--image", 32, "--on", "ray", "-o", tmp_path / "out"]
    for flags, problem in (
        (["--until", "decided"], "nothing to compare"),
        (["--until", "ci=5", "--videos", 11], "the first stage has 10 episodes"),
        (["--until", "ci=5", "--resume"], "--resume: has no effect together with --on"),
    ):
        done = swm(*given, *flags)
        assert done.returncode == 2 and problem in done.stderr, done.stderr
    assert not list(tmp_path.iterdir())


def flag(name, value):
    """An option as arguments."""
    values = value if isinstance(value, list) else [value]
    return [part for item in values for part in (f"--{name}", item)]


def test_a_study_has_the_files_of_one_process(cluster, s3, tmp_path):
    (tmp_path / "colours.toml").write_text(STUDY)
    one, many = tmp_path / "one", f"{s3}/study"
    printed("study", "run", tmp_path / "colours.toml", "-o", one)
    assert ray.get(swm_ray.study(tmp_path / "colours.toml", many))["cells"] == 3
    assert {name: Folder(many).read(name) for name in Folder(many).list()} == files_of(one)
    # On a shared disk, the output is the folder of the study.
    shared = tmp_path / "shared"
    done = swm("study", "run", tmp_path / "colours.toml", "-o", shared, "--on", "ray")
    assert done.returncode == 0, done.stderr
    assert swm_package.studies.read(shared).is_done
    assert swm_package.studies.read(shared).export() == swm_package.studies.read(one).export()


@pytest.mark.parametrize("rule", ["ci=20", "decided=25"])
def test_a_study_that_its_results_end_has_the_files_of_one_process(rule, cluster, s3, tmp_path):
    (tmp_path / "colours.toml").write_text(STUDY)
    one, many = tmp_path / "one", Folder(f"{s3}/study-until-{rule}")
    printed("study", "run", tmp_path / "colours.toml", "episodes=45", "-o", one, "--until", rule)
    summary = ray.get(swm_ray.study(tmp_path / "colours.toml", many.root, until=rule, episodes=45))
    assert {name: many.read(name) for name in many.list()} == files_of(one)
    folder = Folder(summary["folder"])
    stages = sorted({int(name.split("/")[0]) for name in folder.list("parts/stages")})
    assert len(stages) > 1 and stages[0] == 10
    # The cells of a stage are those that the rule left open.
    still_open = [folder.read_json(f"parts/open/{stage:06d}.json") for stage in stages]
    played = [len(folder.list(f"parts/stages/{stage:06d}")) for stage in stages]
    assert played == [2, *map(len, still_open[:-1])] and still_open[-1] == []
    assert swm_ray.progress(folder.root) == {"done": summary["cells"], "cells": summary["cells"]}
    # A driver that starts again after a stage, and has to decide again, decides the same.
    for name in folder.list("cells"):
        if name == "join.json" or name.startswith(f"stage-{stages[-1]:06d}") or name == f"stage-{stages[0]:06d}.json":
            remove(folder.at(f"cells/{name}"))
    again = ray.get(swm_ray.study(tmp_path / "colours.toml", many.root, until=rule, episodes=45))
    assert again["ran"] == 3 + played[-1] and {name: many.read(name) for name in many.list()} == files_of(one)
    # A fixed number of episodes does not follow.
    given = ["study", "run", tmp_path / "colours.toml", "episodes=45", "-o", many.root]
    fixed = swm(*given, "--on", "ray", "--run-folder", f"{s3}/x")
    assert fixed.returncode == 2 and f"--until {rule}" in fixed.stderr, fixed.stderr


def test_a_sweep_has_the_weights_of_single_trainings(cluster, s3, rooms, tmp_path):
    path, *_ = rooms
    settings = ["schedule.steps=6", "schedule.warmup=0", "data.batch_size=4"]
    output = f"{s3}/sweep"
    sweep = {"seed": [0, 1]}
    done = swm_ray.train("lewm", output, *settings, data=path, preset="tiny", sweep=sweep)
    assert ray.get(done)["cells"] == 2
    for seed in (0, 1):
        one = tmp_path / f"seed-{seed}"
        printed("train", "lewm", "--data", path, "--preset", "tiny", "-o", one, *settings, f"seed={seed}")
        weights = "checkpoint/weights.safetensors"
        assert Folder(f"{output}/seed={seed}").read(weights) == (one / weights).read_bytes()
    refused = swm("checkpoints", "remove", f"{output}/seed=0", "--yes")
    assert refused.returncode == 2 and "is a URI, of which this machine has a copy only" in refused.stderr
    # Commands read checkpoints from where the cluster wrote them.
    assert printed("checkpoints", "show", f"{output}/seed=1") == printed("checkpoints", "show", tmp_path / "seed-1") | {
        key: value for key, value in printed("checkpoints", "show", f"{output}/seed=1").items() if key in ("path", "name")
    }


def test_a_training_continues_from_its_last_checkpoint(s3, rooms, tmp_path):
    path, *_ = rooms
    arguments = ["train", "lewm", "--data", path, "--preset", "tiny", "data.batch_size=4", "save_every=2"]
    printed(*arguments, "-o", tmp_path / "one", "schedule.steps=6", "schedule.warmup=0")
    state = TrainingState(f"{s3}/state", tmp_path / "node-a" / "run")
    assert not state.restore()
    printed(*arguments, "-o", tmp_path / "node-a" / "run", "schedule.steps=6", "schedule.warmup=0")
    assert state.store() and not state.store()
    other = TrainingState(f"{s3}/state", tmp_path / "node-b" / "run")
    assert other.restore()
    printed(*arguments, "-o", tmp_path / "node-b" / "run", "schedule.steps=6", "schedule.warmup=0", "--resume")
    names = sorted(path.relative_to(tmp_path / "one").as_posix() for path in (tmp_path / "one").rglob("*.safetensors"))
    assert names
    for name in names:
        assert (tmp_path / "node-b" / "run" / name).read_bytes() == (tmp_path / "one" / name).read_bytes()


def test_a_job_runs_on_another_cluster(cluster, s3, rooms):
    path, _, flags = rooms
    address = cluster.head_node.address_info["webui_url"]
    output = f"{s3}/job.lance"
    done = swm("collect", "swm/TwoRoom-v1", "-o", output, "--on", f"ray://{address}", "--shards", "3", "--json", *flags)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["cells"] == 4
    assert content_hash(output) == content_hash(path)


def test_a_cluster_that_does_not_answer_is_named(s3):
    done = swm("collect", "swm/TwoRoom-v1", "-o", f"{s3}/nowhere.lance", "--on", "ray://127.0.0.1:9", "--no-pixels")
    assert done.returncode == 2 and "http://127.0.0.1:9 does not answer" in done.stderr, done.stderr
