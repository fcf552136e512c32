"""Which methods of the package's classes a user's subclass replaces, so that the engine must not stand in for them."""

from __future__ import annotations

from typing import Any


def is_overridden(given: Any, method: str) -> bool:
    """Whether `method` of an object or a class is a user's."""
    module = getattr(getattr(given, method, None), "__module__", None) or ""
    return bool(module.split(".")[0] != "stable_worldmodel")
