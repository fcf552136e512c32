"""A search for a breaking point on a cluster has the results of one process."""

import copy

import pytest
import ray
from conftest import files_of, printed, remove, swm

import stable_worldmodel.ray as swm_ray
from stable_worldmodel.ray import cells
from stable_worldmodel.ray.folder import Folder

#: A slow agent does not arrive in time.
BREAK = ["study", "break", "expert", "env=swm/TwoRoom-v1", "budget=30", "episodes=20", "image=32"]
BREAK += ["--factor", "agent.speed", "--towards", "1.75"]


@pytest.mark.parametrize("rule", [[], ["--until", "decided=45"]])
def test_a_breaking_point_has_the_files_of_one_process(rule, cluster, s3, tmp_path):
    one, many = tmp_path / "one", Folder(f"{s3}/break-{len(rule)}")
    results = printed(*BREAK, *rule, "-o", one)
    assert results["cells"] == 12, "levels inside an interval"
    submitted = [*BREAK, *rule, "--output", many.root]
    summary = ray.get(swm_ray.submit(submitted))
    assert {name: many.read(name) for name in many.list()} == files_of(one)
    folder = Folder(summary["folder"])
    assert rule or summary["cells"] == 14
    assert swm_ray.progress(folder.root) == {"done": summary["cells"], "cells": summary["cells"]}
    # A driver that starts again after the grid chooses the same levels, and evaluates nothing twice.
    remove(folder.at("cells/levels.json"))
    remove(folder.at("cells/join.json"))
    assert ray.get(swm_ray.submit(submitted))["ran"] == 2
    assert {name: many.read(name) for name in many.list()} == files_of(one)


def test_a_breaking_point_of_values_without_an_order_has_no_levels_inside(cluster, tmp_path):
    given = ["study", "break", "expert", "env=swm/TwoRoom-v1", "budget=5", "episodes=2", "no-pixels=true"]
    done = swm(*given, "--factor", "door.number", "-o", tmp_path / "doors", "--on", "ray", "--json")
    assert done.returncode == 0 and '"cells": 5' in done.stdout, done.stderr
    assert printed("study", "status", tmp_path / "doors")["done"] == 3


def test_the_levels_of_a_folder_are_those_of_the_factor_only(tmp_path):
    folder = Folder(str(tmp_path / "run"))
    request = printed(*BREAK, "-o", tmp_path / "out", "--on", "ray", "--print-request")
    grid = request["cells"]
    assert cells.count(request) == 9 + 1 + 3 + 1
    folder.write_json("parts/levels.json", grid)
    assert cells._with_levels(grid, folder) == grid
    for path, value in (
        (("cells", 1, "request", "env"), "evil:X-v0"),
        (("cells", 1, "request", "conditions", 0, "variation", "variation_values", "agent.speed"), "evil"),
        (("cells", 1, "request", "conditions"), []),
        (("cells", 1, "inputs"), {"weights": "0"}),
        (("until",), "ci=5"),
        (("cells",), grid["study"]["cells"][:3]),
    ):
        found = copy.deepcopy(grid)
        place = found["study"]
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = value
        folder.write_json("parts/levels.json", found)
        with pytest.raises(RuntimeError, match=r"levels\.json is damaged; remove it"):
            cells._with_levels(grid, folder)
    folder.write_json("parts/levels.json", grid | {"ids": ["../evil", *grid["ids"][1:]]})
    with pytest.raises(RuntimeError, match="damaged"):
        cells._with_levels(grid, folder)
