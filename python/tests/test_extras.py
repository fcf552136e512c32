"""Tests of the extras of the package, which users install parts of the engine's features with."""

import os
import re
import subprocess
import sys
from importlib.metadata import requires
from pathlib import Path

import pytest

tomllib = pytest.importorskip("tomllib")
ROOT = Path(__file__).parents[2]
EXTRAS = tomllib.loads((ROOT / "python/pyproject.toml").read_text())["project"]["optional-dependencies"]


def test_page_lists_every_extra():
    rows = re.findall(r"^\| (`[a-z`, ]+`) \|", (ROOT / "docs/install.md").read_text(), re.MULTILINE)
    assert sorted(name for row in rows for name in re.findall("[a-z]+", row)) == sorted(EXTRAS)


def test_extra_all_contains_every_other():
    """But `gym`: its pygame-ce and the pygame of `craftax` are two packages with the same files."""
    (everything,) = EXTRAS["all"]
    assert everything == f"stable-worldmodel-rs[{','.join(sorted(EXTRAS.keys() - {'all', 'gym'}))}]"


def test_wheel_has_the_requirements_of_every_extra():
    found = requires("stable-worldmodel-rs")
    for extra, expected in EXTRAS.items():
        names = {re.split(r"[^\w.-]", line)[0] for line in found if f"extra == '{extra}'" in line.replace('"', "'")}
        assert names == {re.split(r"[^\w.-]", line)[0] for line in expected}, extra


def test_command_runs_packages_in_its_own_interpreter(tmp_path):
    """The `swm` of an environment that is not activated finds what is installed beside it, not what is on the path."""
    environment = {name: value for name, value in os.environ.items() if name != "SWM_PYTHON"}
    environment.update(PATH=str(tmp_path), SWM_ASSETS=str(tmp_path))
    arguments = ["collect", "CartPole-v1", "-o", "poles", "--policy", "random", "--episodes", "1", "--no-pixels"]
    done = subprocess.run(
        [sys.executable, "-m", "stable_worldmodel", *arguments], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
