"""`AcrobotWrapper`."""

from __future__ import annotations

from typing import Any

from .base import GymControlWrapper

__all__ = ["AcrobotWrapper"]


class AcrobotWrapper(GymControlWrapper):
    """Acrobot."""

    def __init__(self, env_id: str = "Acrobot-v1", render_mode: str | None = None, **kwargs: Any) -> None:
        super().__init__(env_id, render_mode, **kwargs)
