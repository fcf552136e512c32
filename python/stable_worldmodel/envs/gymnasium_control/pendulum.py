"""`PendulumWrapper`."""

from __future__ import annotations

from typing import Any

from .base import GymControlWrapper

__all__ = ["PendulumWrapper"]


class PendulumWrapper(GymControlWrapper):
    """Pendulum."""

    def __init__(self, env_id: str = "Pendulum-v1", render_mode: str | None = None, **kwargs: Any) -> None:
        super().__init__(env_id, render_mode, **kwargs)
