"""Evaluations, studies and trainings on a cluster have the results of one process."""

import json

import ray
from conftest import content_hash, printed, swm

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
        run.pop("videos")
    return results


def test_an_evaluation_has_the_results_of_one_process(cluster, s3, tmp_path):
    flags = [part for name, value in EVALUATION.items() for part in flag(name, value)]
    printed("eval", "expert", "no-op", "--env", "swm/TwoRoom-v1", "-o", tmp_path / "one", "--videos", "0", *flags)
    output = f"{s3}/colours"
    done = swm_ray.evaluate(["expert", "no-op"], output, env="swm/TwoRoom-v1", **EVALUATION)
    assert ray.get(done)["cells"] == 4
    one = json.loads((tmp_path / "one" / "results.json").read_text())
    assert without_times(Folder(output).read_json("results.json")) == without_times(one)


def flag(name, value):
    """An option as arguments."""
    values = value if isinstance(value, list) else [value]
    return [part for item in values for part in (f"--{name}", item)]


def test_a_study_has_the_files_of_one_process(cluster, s3, tmp_path):
    (tmp_path / "colours.toml").write_text(STUDY)
    one, many = tmp_path / "one", f"{s3}/study"
    printed("study", "run", tmp_path / "colours.toml", "-o", one)
    assert ray.get(swm_ray.study(tmp_path / "colours.toml", many))["cells"] == 3
    files = {path.relative_to(one).as_posix(): path.read_bytes() for path in one.rglob("*") if path.is_file()}
    files = {name: content for name, content in files.items() if not name.startswith(".")}
    assert {name: Folder(many).read(name) for name in Folder(many).list()} == files
    # On a shared disk, the output is the folder of the study.
    shared = tmp_path / "shared"
    done = swm("study", "run", tmp_path / "colours.toml", "-o", shared, "--on", "ray")
    assert done.returncode == 0, done.stderr
    assert swm_package.studies.read(shared).is_done
    assert swm_package.studies.read(shared).export() == swm_package.studies.read(one).export()


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
