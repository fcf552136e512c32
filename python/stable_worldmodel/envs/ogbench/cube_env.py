"""`CubeEnv`."""

from __future__ import annotations

from typing import Any

from .table import TableEnv

__all__ = ["CubeEnv"]


class CubeEnv(TableEnv):
    """A robot arm and cubes on a table: `swm/OGBCube-v0`.

    Args:
        env_type: `single`, `double`, …: the number of cubes.
        ob_type: `states` or `pixels`.
        permute_blocks: Must be true.
        multiview: Whether `render_multiview` renders two cameras; the factor `camera.angle_delta` turns the first.
        height, width: Size of the frames in pixels, which are square.
        **kwargs: `render_mode`, and options of the environment.
    """

    id = "swm/OGBCube-v0"

    def __init__(
        self,
        env_type: str = "single",
        ob_type: str = "states",
        permute_blocks: bool = True,
        multiview: bool = False,
        height: int = 224,
        width: int = 224,
        *args: Any,
        **kwargs: Any,
    ) -> None:
        self._refuse(permute_blocks=(permute_blocks, True))
        self._refuse(args=(args, ()), width=(width, height))
        render_mode = kwargs.pop("render_mode", "rgb_array")
        options = {"env_type": env_type, "ob_type": ob_type, **kwargs}
        super().__init__(render_mode, resolution=height, options=options)
        self._begin_table(multiview, options)

    def set_target_pos(self, cube_id: int, target_pos: Any, target_quat: Any = None) -> None:
        """Sets the goal of a cube; the goal then includes all cubes.

        Args:
            cube_id: The index of the cube.
            target_pos: Its position `(3,)` in metres.
            target_quat: Its rotation `(4,)`, a quaternion; the goal's present one for `None`.
        """
        self._set_cube_goal(cube_id, target_pos, target_quat)
