"""Runs the commands of the tutorial on a cluster, with smaller numbers."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

from conftest import content_hash

ROOT = Path(__file__).parents[2]


def test_the_commands_of_the_tutorial_run(cluster, tmp_path):
    text = (ROOT / "docs/tutorials/several-machines.md").read_text()
    # `sh` blocks need no cluster: other tests run them as well.
    blocks = re.findall(r"^```(?:sh|bash)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    environment = {**os.environ, "SWM_ZOO": str(ROOT / "zoo")}
    for line in "".join(blocks).replace("\\\n", " ").splitlines():
        words = shlex.split(
            re.sub(r"(episodes[ =])\d+", r"\g<1>6", line).replace("steps=200", "steps=4").replace("every=50", "every=2")
        )
        assert words[0] == "swm"
        if words[1] == "study":
            words.append("episodes=2")
        if words[1] == "train":
            words += ["schedule.warmup=0", "data.batch_size=4"]
        command = [sys.executable, "-m", "stable_worldmodel", *words[1:]]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
    assert content_hash(tmp_path / "many.lance") == content_hash(tmp_path / "one.lance")
