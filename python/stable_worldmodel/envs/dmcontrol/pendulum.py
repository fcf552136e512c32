"""`PendulumDMControlWrapper`."""

from __future__ import annotations

from typing import Any

from .dmcontrol import DMControlWrapper

__all__ = ["PendulumDMControlWrapper"]


class PendulumDMControlWrapper(DMControlWrapper):
    """Pendulum of the DeepMind Control suite: `swm/PendulumDMControl-v0`."""

    id = "swm/PendulumDMControl-v0"

    def __init__(self, seed: int | None = None, environment_kwargs: Any = None, render_mode: str | None = None) -> None:
        super().__init__(None, seed, environment_kwargs, render_mode)
