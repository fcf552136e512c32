"""`MazeEnv`."""

from __future__ import annotations

from typing import Any

from ..mujoco import MujocoEnv

__all__ = ["MazeEnv"]


class MazeEnv(MujocoEnv):
    """A point or an ant in a maze: `swm/OGBMaze-v0`.

    Args:
        loco_env_type, maze_env_type, maze_type: The body, the kind of task and the maze, options of the environment.
        ob_type: `states` or `pixels`.
        width, height: Size of the frames in pixels, which are square.
        **kwargs: `render_mode`, and options of the environment.
    """

    id = "swm/OGBMaze-v0"

    def __init__(
        self,
        loco_env_type: str = "point",
        maze_env_type: str = "maze",
        maze_type: str = "large",
        ob_type: str = "states",
        width: int = 224,
        height: int = 224,
        **kwargs: Any,
    ) -> None:
        self._refuse(width=(width, height), maze_env_type=(maze_env_type, "maze"))
        options = {"loco_env_type": loco_env_type, "maze_type": maze_type, "ob_type": ob_type, **kwargs}
        super().__init__(options.pop("render_mode", "rgb_array"), resolution=height, options=options)
        self.env_name = f"{loco_env_type.capitalize()}Maze"
