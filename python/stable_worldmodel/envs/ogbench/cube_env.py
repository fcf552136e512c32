"""`CubeEnv`."""

from __future__ import annotations

from typing import Any

from ..named import NamedEnv

__all__ = ["CubeEnv"]


class CubeEnv(NamedEnv):
    """A robot arm and cubes on a table: `swm/OGBCube-v0`.

    Args:
        env_type: `single`, `double`, …: the number of cubes.
        ob_type: `states` or `pixels`.
        permute_blocks: Must be true.
        multiview: Must be false; `render_view` renders other cameras.
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
        self._refuse(permute_blocks=(permute_blocks, True), multiview=(multiview, False))
        self._refuse(args=(args, ()), width=(width, height))
        render_mode = kwargs.pop("render_mode", "rgb_array")
        options = {"env_type": env_type, "ob_type": ob_type, **kwargs}
        super().__init__(render_mode, resolution=height, options=options)
