"""`QuadrupedDMControlWrapper`."""

from __future__ import annotations

from typing import Any

from .dmcontrol import DMControlWrapper

__all__ = ["QuadrupedDMControlWrapper"]


class QuadrupedDMControlWrapper(DMControlWrapper):
    """Quadruped of the DeepMind Control suite: `swm/QuadrupedDMControl-v0`."""

    id = "swm/QuadrupedDMControl-v0"

    def __init__(
        self, task: str = "walk", seed: int | None = None, environment_kwargs: Any = None, render_mode: str | None = None
    ) -> None:
        super().__init__(task, seed, environment_kwargs, render_mode)
