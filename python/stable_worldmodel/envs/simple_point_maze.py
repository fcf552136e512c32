"""`SimplePointMazeEnv`."""

from __future__ import annotations

import numpy as np

from .named import NamedEnv

__all__ = ["SimplePointMazeEnv"]


class SimplePointMazeEnv(NamedEnv):
    """A point among walls: `swm/SimplePointMaze-v0`.

    Args:
        max_walls, min_walls, wall_min_size, wall_max_size: Must have their defaults; walls are factors of variation.
        render_mode: `"rgb_array"` or `None`.
        show_goal: Must be true.
    """

    id = "swm/SimplePointMaze-v0"

    def __init__(
        self,
        max_walls: int = 6,
        min_walls: int = 4,
        wall_min_size: float = 0.5,
        wall_max_size: float = 1.5,
        render_mode: str | None = None,
        show_goal: bool = True,
    ) -> None:
        self._refuse(max_walls=(max_walls, 6), min_walls=(min_walls, 4), show_goal=(show_goal, True))
        self._refuse(wall_min_size=(wall_min_size, 0.5), wall_max_size=(wall_max_size, 1.5))
        super().__init__(render_mode)

    def render(self, mode: str | None = None) -> np.ndarray | None:
        """The frame; `mode` replaces the render mode of the constructor."""
        if mode in (None, self.render_mode):
            return super().render()
        return self._env.render(*self.image_shape, False) if mode == "rgb_array" else None
