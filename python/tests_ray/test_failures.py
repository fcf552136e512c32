"""Errors name the cell, the node and the cause, after bounded retries, and other cells are kept."""

import textwrap

import pytest
import ray
from conftest import add_node, printed, swm, until

import stable_worldmodel
from stable_worldmodel.ray import driver
from stable_worldmodel.ray.driver import CellsFailed, RunRefused
from stable_worldmodel.ray.folder import Folder


def request(folder, **changed):
    """A request with the cells of the test."""
    request = {"kind": "test", "version": stable_worldmodel.__version__, "arguments": [], "output": folder, "folder": folder}
    return request | {"directory": "/", "resources": {"cpu": 1}, "cells": {}} | changed


@pytest.fixture
def run(monkeypatch):
    """Runs cells, each an id and the arguments of a command."""

    def run(folder, cells, **changed):
        listed = [{"id": name, "name": name, "arguments": arguments} for name, arguments in cells.items()]
        monkeypatch.setattr(driver, "stages", lambda _: [listed])
        monkeypatch.setattr(driver, "count", lambda _: len(listed))
        return driver.execute(request(folder, **changed))

    return run


def test_a_cell_that_always_fails_is_named_and_the_others_are_kept(cluster, tmp_path, run):
    folder = str(tmp_path / "run")
    cells = {"good-1": ["envs"], "bad": ["fovs", "swm/Nowhere-v1"], "good-2": ["solvers"]}
    with pytest.raises(CellsFailed) as raised:
        run(folder, cells)
    text = str(raised.value)
    assert "1 cells failed after 4 attempts each; 2 of 3 cells are done and kept" in text
    assert "cell 'bad' on node " in text and "swm/Nowhere-v1" in text and "exit code 2" in text
    assert Folder(folder).list("cells") == ["good-1.json", "good-2.json"]
    # The cause is corrected: only the cell that failed runs.
    assert run(folder, cells | {"bad": ["wrappers"]})["ran"] == 1


def test_a_run_whose_cells_all_fail_ends_early(cluster, tmp_path, run, monkeypatch):
    monkeypatch.setattr(driver, "HOPELESS", 2)
    monkeypatch.setattr(driver, "RETRIES", 0)
    with pytest.raises(CellsFailed, match="cell 'bad-"):
        run(str(tmp_path / "run"), {f"bad-{index}": ["fovs", "swm/Nowhere-v1"] for index in range(40)})


def shadow(tmp_path, name, text):
    """A folder that Python searches before the package of a node."""
    package = tmp_path / name / "stable_worldmodel"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text(textwrap.dedent(text))
    return {"PYTHONPATH": str(package.parent)}


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("missing", "raise ModuleNotFoundError(\"No module named 'stable_worldmodel'\")", "cannot import the package"),
        ("older", "__version__ = '0.0.1'\nclass _engine:\n    cpu_level = staticmethod(lambda: '')", "has version 0.0.1"),
        (
            "other",
            f"__version__ = {stable_worldmodel.__version__!r}\nclass _engine:\n    cpu_level = staticmethod(lambda: 'm68k')",
            "different processor levels: .* has m68k",
        ),
    ],
)
def test_a_node_that_does_not_fit_is_named_before_any_cell_runs(cluster, tmp_path, run, name, text, problem):
    node = add_node(cluster, env_vars=shadow(tmp_path, name, text), num_cpus=1)
    try:
        with pytest.raises(RunRefused, match=problem) as raised:
            run(str(tmp_path / "run"), {"good": ["envs"]})
        assert node.node_id[:8] in str(raised.value)
        assert Folder(str(tmp_path / "run")).list("cells") == []
    finally:
        cluster.remove_node(node)


def test_a_driver_of_another_version_is_refused(cluster, tmp_path, run):
    with pytest.raises(RunRefused, match="has version .* of stable_worldmodel, and the run 9.9.9"):
        run(str(tmp_path / "run"), {"good": ["envs"]}, version="9.9.9")


def test_a_store_that_cannot_be_reached_is_named(cluster, s3):
    options = ["--on", "ray", "--episodes", "2", "--no-pixels"]
    nowhere = {"AWS_ENDPOINT_URL": "http://127.0.0.1:9"}
    done = swm("collect", "swm/TwoRoom-v1", "-o", f"{s3}/unreachable.lance", *options, **nowhere)
    assert done.returncode == 1 and "s3://lab" in done.stderr, done.stderr


def test_references_to_a_run_that_is_refused_raise(cluster, tmp_path):
    import stable_worldmodel.ray as swm_ray

    with pytest.raises(ValueError, match="swm/Nowhere-v1"):
        swm_ray.collect("swm/Nowhere-v1", tmp_path / "a.lance")
    with pytest.raises(ray.exceptions.RayTaskError, match="level"):
        folder = Folder(str(tmp_path / "b.lance.ray"))
        given = ["collect", "swm/TwoRoom-v1", "-o", tmp_path / "b.lance", "--episodes", 2, "--no-pixels", "--on", "ray"]
        folder.write_json("request.json", printed(*given, "--print-request"))
        folder.write_json("level.json", "m68k")
        ray.get(swm_ray.collect("swm/TwoRoom-v1", tmp_path / "b.lance", episodes=2, no_pixels=True))


def test_a_run_ends_whose_resources_no_node_has(cluster, tmp_path, run, capsys):
    with pytest.raises(RunRefused) as raised:
        run(str(tmp_path / "run"), {"good": ["envs"]}, resources={"cpu": 1, "fpga": 2}, wait=1)
    text = str(raised.value)
    assert "no node has cpu=1, fpga=2" in text and "the largest one has cpu=1, fpga=0" in text
    assert "within 1 s" in text and "--resources" in text and "--wait" in text
    assert "waiting 1 s for one to join" in capsys.readouterr().err
    # What another run takes decides nothing: the same folder continues.
    assert run(str(tmp_path / "run"), {"good": ["envs"]})["ran"] == 1
    # On the command line.
    arguments = ["collect", "swm/TwoRoom-v1", "-o", tmp_path / "a.lance", "--episodes", 2, "--no-pixels", "--on", "ray"]
    done = swm(*arguments, "--resources", "gpu=1", "--wait", 0)
    assert done.returncode == 2 and "no node has cpu=1, gpu=1" in done.stderr, done.stderr


def test_cells_wait_for_a_node_that_joins(cluster, tmp_path):
    import stable_worldmodel.ray as swm_ray

    output = tmp_path / "a.lance"
    options = {"episodes": 2, "no_pixels": True, "resources": {"cpu": 1, "fpga": 1}, "wait": 300}
    done = swm_ray.collect("swm/TwoRoom-v1", output, **options)
    # The run has begun, and its cells wait.
    until(lambda: Folder(f"{output}.ray").read_json("level.json"))
    node = add_node(cluster, resources={"fpga": 1})
    try:
        assert ray.get(done)["cells"] == 2
        record = Folder(f"{output}.ray").read_json("cells/000000.json")
        assert node.node_id[:8] in record["node"]
    finally:
        cluster.remove_node(node)


def test_the_time_begins_anew_while_an_autoscaler_starts_nodes(cluster, monkeypatch):
    from stable_worldmodel.ray import supply

    starts, now = [True, True, False], [0.0]
    monkeypatch.setattr(supply.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(supply, "_nodes_start", lambda: starts.pop(0))
    waiting = supply.Supply({"fpga": 1}, 10)
    for second in (0, 20, 40):
        now[0] = float(second)
        waiting.check()
    now[0] = 60.0
    with pytest.raises(RunRefused, match="fpga=1"):
        waiting.check()
