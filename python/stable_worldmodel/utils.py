"""The home folder, and descriptions of environments and visual wrappers."""

from __future__ import annotations

import json
from typing import Any

from . import _engine

__all__ = ["describe", "home", "wrappers"]


def home() -> str:
    """The home folder of datasets and checkpoints given by name: `$STABLEWM_HOME`, or `~/.stable_worldmodel`."""
    return _engine.home()


def describe(env: str) -> dict[str, Any]:
    """The description of an environment: spaces, info columns, factors of variation, options, experts."""
    return json.loads(_engine.spec(env))


def wrappers() -> dict[str, Any]:
    """The settings of every visual wrapper, by its id."""
    return json.loads(_engine.wrappers())
