"""`TwoRoomEnv`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..named import NamedEnv

__all__ = ["TwoRoomEnv"]


class TwoRoomEnv(NamedEnv):
    """Two rooms with doors between them: `swm/TwoRoom-v1`.

    Args:
        render_mode: `"rgb_array"` or `None`.
        render_target: Must be false; `render_goal` renders the goal.
        init_value: Values of factors for episodes that do not vary them.
    """

    id = "swm/TwoRoom-v1"

    def __init__(
        self,
        render_mode: str | None = "rgb_array",
        render_target: bool = False,
        init_value: Mapping[str, Any] | None = None,
    ) -> None:
        self._refuse(render_target=(render_target, False))
        super().__init__(render_mode, init_value)
