"""Runs the commands and programs of the quick starts, the tutorials, the cookbook and the README, with smaller numbers.

Blocks marked `sh` hold commands, blocks marked `python` hold programs, which share one namespace. A block that begins with
the name of a file, such as `# my_envs.py`, is written to that file instead. Other blocks are not run.
"""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [
    "README.md",
    "docs/quickstart-terminal.md",
    "docs/quickstart-python.md",
    "docs/cookbook.md",
    *sorted(str(path.relative_to(ROOT)) for path in (ROOT / "docs/tutorials").glob("*.md") if path.name != "README.md"),
]
#: The program; by default the one of the installed package.
PROGRAM = [os.environ["SWM"]] if "SWM" in os.environ else [sys.executable, "-m", "stable_worldmodel"]
#: The largest number of collected and of other episodes, and the number of training steps.
COLLECTED, EPISODES, STEPS = 60, 4, 4
#: The capsules that come with the program.
ZOO = ROOT / "zoo"


def blocks(page):
    """The marked blocks of a page: the mark and the text."""
    return re.findall(r"^```(\w+)\n(.*?)^```$", (ROOT / page).read_text(), re.MULTILINE | re.DOTALL)


def smaller(text, episodes=EPISODES):
    """The text with fewer episodes and epochs."""

    def fewer(match):
        return f"{match[1]}{min(int(match[2]), episodes)}"

    text = re.sub(r"((?:--episodes |\bepisodes=))(\d+)", fewer, text)
    return re.sub(r"range\(\d+\):\n    for batch in loader", "range(1):\n    for batch in loader", text)


def command(line):
    """The arguments of a command, with fewer episodes and training steps."""
    words = shlex.split(smaller(line, COLLECTED if line.startswith("swm collect") else EPISODES))
    if words[0] == "mkdir":
        return words
    assert words[0] == "swm", f"a block of commands has the line {line}"
    if words[1] == "train" and "--resume" not in words:
        words = [word for word in words if not word.startswith("schedule.steps=")] + [f"schedule.steps={STEPS}", "log_every=1"]
    return [*PROGRAM, *words[1:]]


def run_commands(text, page):
    lines = text.replace("\\\n", " ").splitlines()
    for line in lines:
        if line.strip() and not line.startswith("#"):
            done = subprocess.run(command(line), capture_output=True, text=True)
            assert done.returncode == 0, f"{page}: {line}\n{done.stdout}{done.stderr}"


@pytest.mark.parametrize("page", PAGES)
def test_commands_and_programs_of_a_page_run(page, tmp_path, monkeypatch):
    found = blocks(page)
    if any("torch" in text for mark, text in found if mark == "python"):
        pytest.importorskip("torch").set_num_threads(1)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SWM_PYTHON", sys.executable)
    monkeypatch.setenv("SWM_ZOO", str(ZOO))
    monkeypatch.syspath_prepend(str(tmp_path))
    namespace = {"__name__": "page"}
    ran = 0
    for mark, text in found:
        file = re.match(r"# ([\w.]+)\n", text)
        if file and mark in ("python", "toml"):
            (tmp_path / file[1]).write_text(smaller(text).replace("episodes = 50", "episodes = 4"))
        elif mark == "python":
            exec(compile(smaller(text), page, "exec"), namespace)
            ran += 1
        elif mark == "sh":
            run_commands(text, page)
            ran += 1
    assert ran > 0, f"{page} has no block that runs"
