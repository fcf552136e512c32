"""`HopperDMControlWrapper`."""

from __future__ import annotations

from typing import Any

from .dmcontrol import DMControlWrapper

__all__ = ["HopperDMControlWrapper"]


class HopperDMControlWrapper(DMControlWrapper):
    """Hopper of the DeepMind Control suite: `swm/HopperDMControl-v0`."""

    id = "swm/HopperDMControl-v0"

    def __init__(
        self, task: str = "hop", seed: int | None = None, environment_kwargs: Any = None, render_mode: str | None = None
    ) -> None:
        super().__init__(task, seed, environment_kwargs, render_mode)
