"""`WeakPolicy` of Push-T."""

from __future__ import annotations

from typing import Any

from ..named import ScriptedExpert

__all__ = ["WeakPolicy"]


class WeakPolicy(ScriptedExpert):
    """Moves at random near the block, for collections with contact.

    Args:
        dist_constraint: Must be 100: the largest distance from the block's centre along an axis.
        seed: Combined with the seed of each episode.
    """

    expert = "weak"

    def __init__(self, dist_constraint: float = 100, seed: int | None = None, **kwargs: Any) -> None:
        self._refuse(dist_constraint=(dist_constraint, 100))
        super().__init__(0.0, seed, **kwargs)
