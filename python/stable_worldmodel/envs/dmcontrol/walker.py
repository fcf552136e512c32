"""`WalkerDMControlWrapper`."""

from __future__ import annotations

from typing import Any

from .dmcontrol import DMControlWrapper

__all__ = ["WalkerDMControlWrapper"]


class WalkerDMControlWrapper(DMControlWrapper):
    """Walker of the DeepMind Control suite: `swm/WalkerDMControl-v0`."""

    id = "swm/WalkerDMControl-v0"

    def __init__(
        self, task: str = "walk", seed: int | None = None, environment_kwargs: Any = None, render_mode: str | None = None
    ) -> None:
        super().__init__(task, seed, environment_kwargs, render_mode)
