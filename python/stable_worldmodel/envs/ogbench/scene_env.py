"""`SceneEnv`."""

from __future__ import annotations

from typing import Any

from ..named import NamedEnv

__all__ = ["SceneEnv"]


class SceneEnv(NamedEnv):
    """A robot arm and a scene on a table: `swm/OGBScene-v0`.

    Args:
        env_type: Must be `scene`.
        ob_type: `states` or `pixels`.
        permute_blocks: Must be true.
        multiview: Must be false; `render_view` renders other cameras.
        **kwargs: `render_mode`, and options of the environment.
    """

    id = "swm/OGBScene-v0"

    def __init__(
        self,
        env_type: str = "scene",
        ob_type: str = "states",
        permute_blocks: bool = True,
        multiview: bool = False,
        *args: Any,
        **kwargs: Any,
    ) -> None:
        self._refuse(permute_blocks=(permute_blocks, True), multiview=(multiview, False))
        self._refuse(args=(args, ()))
        render_mode = kwargs.pop("render_mode", "rgb_array")
        self._refuse(env_type=(env_type, "scene"))
        super().__init__(render_mode, options={"ob_type": ob_type, **kwargs})
