"""Every test has a home of its own, so that names of datasets and checkpoints meet nothing of yours."""

import os
import signal
from pathlib import Path

import pytest

# Whoever runs the tests in the background may have made them deaf to Ctrl-C; the programs they start must hear it.
signal.signal(signal.SIGINT, signal.default_int_handler)

#: Where what `swm assets` brought is: not in a test's home.
ASSETS = Path(os.environ.get("STABLEWM_HOME") or Path.home() / ".stable_worldmodel") / "assets"


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("SWM_ASSETS", os.environ.get("SWM_ASSETS") or str(ASSETS))
    monkeypatch.setenv("STABLEWM_HOME", str(tmp_path / "home"))
    return tmp_path / "home"
