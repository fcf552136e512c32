"""`ReacherDMControlWrapper`."""

from __future__ import annotations

from typing import Any

from .dmcontrol import DMControlWrapper

__all__ = ["ReacherDMControlWrapper"]


class ReacherDMControlWrapper(DMControlWrapper):
    """Reacher of the DeepMind Control suite: `swm/ReacherDMControl-v0`."""

    id = "swm/ReacherDMControl-v0"

    def __init__(
        self, task: str = "hard", seed: int | None = None, environment_kwargs: Any = None, render_mode: str | None = None
    ) -> None:
        super().__init__(task, seed, environment_kwargs, render_mode)
