"""`PushT`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..named import NamedEnv

__all__ = ["Body", "PushT"]


@dataclass(frozen=True)
class Body:
    """The pose of a body at the time it was read.

    Attributes:
        position: The position `(x, y)` in units of the table, whose side is 512.
        angle: The angle in radians.
        velocity: The velocity `(x, y)` in units per second.
    """

    position: tuple[float, float]
    angle: float = 0.0
    velocity: tuple[float, float] = (0.0, 0.0)


class PushT(NamedEnv):
    """A disc that pushes a block to a goal: `swm/PushT-v1`.

    Args:
        block_cog, damping: Must be `None`: the physics are fixed.
        render_action: Must be false.
        resolution: Side of the frames in pixels.
        with_target: Must be true: frames show the goal.
        render_mode: `"rgb_array"` or `None`.
        relative: Must be true: actions are relative to the agent.
        init_value: Values of factors for episodes that do not vary them.
    """

    id = "swm/PushT-v1"

    def __init__(
        self,
        block_cog: Any = None,
        damping: float | None = None,
        render_action: bool = False,
        resolution: int = 224,
        with_target: bool = True,
        render_mode: str | None = "rgb_array",
        relative: bool = True,
        init_value: Mapping[str, Any] | None = None,
    ) -> None:
        self._refuse(block_cog=(block_cog, None), damping=(damping, None), render_action=(render_action, False))
        self._refuse(with_target=(with_target, True), relative=(relative, True))
        super().__init__(render_mode, init_value, resolution)

    @property
    def agent(self) -> Body:
        """The disc."""
        x, y, *_, dx, dy = self._state()
        return Body((x, y), velocity=(dx, dy))

    @property
    def block(self) -> Body:
        """The block."""
        _, _, x, y, angle, *_ = self._state()
        return Body((x, y), angle)

    @property
    def goal_state(self) -> np.ndarray:
        """The goal state `(7,)`."""
        return self._columns()["goal_state"]  # type: ignore[no-any-return]

    @property
    def goal_pose(self) -> np.ndarray:
        """The position and the angle of the block at the goal, `(3,)`."""
        return self.goal_state[2:5]

    def _state(self) -> list[float]:
        return [float(value) for value in self._columns()["state"]]

    def eval_state(self, goal_state: Any, cur_state: Any) -> tuple[bool, float]:
        """Whether a state `(7,)` satisfies a goal state, and the distance of the two.

        The goal is satisfied if the positions of agent and block differ by less than 20 units, and the angle by less than 20
        degrees. The distance is that of all elements.
        """
        off = np.asarray(cur_state, np.float64) - np.asarray(goal_state, np.float64)
        turn = abs((off[4] + np.pi) % (2 * np.pi) - np.pi)
        return bool(np.linalg.norm(off[:4]) < 20 and turn < np.pi / 9), float(np.linalg.norm(off))
