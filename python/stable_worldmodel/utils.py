"""Small helpers."""

from __future__ import annotations

import json
from typing import Any

from . import _engine

__all__ = ["describe", "home", "wrappers"]


def home() -> str:
    """The folder everything without a path of its own lives in: `$STABLEWM_HOME`, or `~/.stable_worldmodel`."""
    return _engine.home()


def describe(env: str) -> dict[str, Any]:
    """What an environment is: spaces, infos, factors of variation, options, experts."""
    return json.loads(_engine.spec(env))


def wrappers() -> dict[str, Any]:
    """The visual wrappers and their settings."""
    return json.loads(_engine.wrappers())
