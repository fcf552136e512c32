"""Gives every test its own home folder, so that tests do not find the datasets and checkpoints of the user."""

import os
import signal
from pathlib import Path

import pytest

# A shell ignores SIGINT in background jobs; the programs that tests start must receive it.
signal.signal(signal.SIGINT, signal.default_int_handler)

#: The folder of `swm assets`, which is not in a test's home.
ASSETS = Path(os.environ.get("STABLEWM_HOME") or Path.home() / ".stable_worldmodel") / "assets"


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("SWM_ASSETS", os.environ.get("SWM_ASSETS") or str(ASSETS))
    monkeypatch.setenv("STABLEWM_HOME", str(tmp_path / "home"))
    return tmp_path / "home"
