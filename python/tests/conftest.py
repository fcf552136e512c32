"""Every test has a home of its own, so that names of datasets and checkpoints meet nothing of yours."""

import pytest


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("STABLEWM_HOME", str(tmp_path / "home"))
    return tmp_path / "home"
