"""`PiecewiseEnv`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..named import NamedEnv

__all__ = ["PiecewiseEnv"]


class PiecewiseEnv(NamedEnv):
    """A plane whose regions move the agent differently: `swm/Piecewise-v0`.

    Args:
        render_mode: `"rgb_array"` or `None`.
        render_target: Must be false; `render_goal` renders the goal.
        grid_n: Must be 2: regions in a row.
        init_value: Values of factors for episodes that do not vary them.
    """

    id = "swm/Piecewise-v0"

    def __init__(
        self,
        render_mode: str | None = "rgb_array",
        render_target: bool = False,
        grid_n: int = 2,
        init_value: Mapping[str, Any] | None = None,
    ) -> None:
        self._refuse(render_target=(render_target, False), grid_n=(grid_n, 2))
        super().__init__(render_mode, init_value)
