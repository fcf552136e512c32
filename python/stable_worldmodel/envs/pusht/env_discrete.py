"""`PushTDiscrete`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .env import PushT

__all__ = ["PushTDiscrete"]


class PushTDiscrete(PushT):
    """Push-T with actions on a polar grid: `swm/PushT-Discrete-v1`.

    Args:
        quantizer: Must be `None`: the grid has 16 radii and 16 angles.
        block_cog, damping, render_action, resolution, with_target, render_mode, relative, init_value: As for `PushT`.
    """

    id = "swm/PushT-Discrete-v1"

    def __init__(
        self,
        quantizer: Any = None,
        block_cog: Any = None,
        damping: float | None = None,
        render_action: bool = False,
        resolution: int = 224,
        with_target: bool = True,
        render_mode: str | None = "rgb_array",
        relative: bool = True,
        init_value: Mapping[str, Any] | None = None,
    ) -> None:
        self._refuse(quantizer=(quantizer, None))
        super().__init__(block_cog, damping, render_action, resolution, with_target, render_mode, relative, init_value)

    def step(self, quantized_action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Applies an action: the indices of a radius and an angle."""
        return super().step(quantized_action)
