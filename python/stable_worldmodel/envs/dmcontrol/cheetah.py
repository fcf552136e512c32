"""`CheetahDMControlWrapper`."""

from __future__ import annotations

from typing import Any

from .dmcontrol import DMControlWrapper

__all__ = ["CheetahDMControlWrapper"]


class CheetahDMControlWrapper(DMControlWrapper):
    """Cheetah of the DeepMind Control suite: `swm/CheetahDMControl-v0`."""

    id = "swm/CheetahDMControl-v0"

    def __init__(
        self, task: str = "run", seed: int | None = None, environment_kwargs: Any = None, render_mode: str | None = None
    ) -> None:
        super().__init__(task, seed, environment_kwargs, render_mode)
