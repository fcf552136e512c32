"""`HumanoidDMControlWrapper`."""

from __future__ import annotations

from typing import Any

from .dmcontrol import DMControlWrapper

__all__ = ["HumanoidDMControlWrapper"]


class HumanoidDMControlWrapper(DMControlWrapper):
    """Humanoid of the DeepMind Control suite: `swm/HumanoidDMControl-v0`."""

    id = "swm/HumanoidDMControl-v0"

    def __init__(
        self, task: str = "walk", seed: int | None = None, environment_kwargs: Any = None, render_mode: str | None = None
    ) -> None:
        super().__init__(task, seed, environment_kwargs, render_mode)
