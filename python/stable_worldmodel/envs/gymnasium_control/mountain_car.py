"""`MountainCarWrapper` and `MountainCarContinuousWrapper`."""

from __future__ import annotations

from typing import Any

from .base import GymControlWrapper

__all__ = ["MountainCarContinuousWrapper", "MountainCarWrapper"]


class MountainCarContinuousWrapper(GymControlWrapper):
    """Mountain car with continuous actions."""

    def __init__(self, env_id: str = "MountainCarContinuous-v0", render_mode: str | None = None, **kwargs: Any) -> None:
        super().__init__(env_id, render_mode, **kwargs)


class MountainCarWrapper(GymControlWrapper):
    """Mountain car."""

    def __init__(self, env_id: str = "MountainCar-v0", render_mode: str | None = None, **kwargs: Any) -> None:
        super().__init__(env_id, render_mode, **kwargs)
