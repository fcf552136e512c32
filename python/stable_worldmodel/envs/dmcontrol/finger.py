"""`FingerDMControlWrapper`."""

from __future__ import annotations

from typing import Any

from .dmcontrol import DMControlWrapper

__all__ = ["FingerDMControlWrapper"]


class FingerDMControlWrapper(DMControlWrapper):
    """Finger of the DeepMind Control suite: `swm/FingerDMControl-v0`."""

    id = "swm/FingerDMControl-v0"

    def __init__(
        self, task: str = "turn_hard", seed: int | None = None, environment_kwargs: Any = None, render_mode: str | None = None
    ) -> None:
        super().__init__(task, seed, environment_kwargs, render_mode)
