"""`FetchWrapper`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..named import NamedEnv

__all__ = ["FetchWrapper"]


class FetchWrapper(NamedEnv):
    """A task of the Fetch robot, with factors of variation.

    Args:
        env_id: The id, such as `FetchPush-v3` or `FetchPushDense-v3`; also with the prefix `swm/`.
        init_value: Values of factors for episodes that do not vary them.
        resolution: Side of the frames in pixels.
        render_mode: `"rgb_array"` or `None`.
        flatten: Whether observations are arrays; otherwise dicts, as of `FetchPushDict-v3`.
        **kwargs: Options of the environment.
    """

    def __init__(
        self,
        env_id: str,
        init_value: Mapping[str, Any] | None = None,
        resolution: int = 224,
        render_mode: str | None = None,
        flatten: bool = True,
        **kwargs: Any,
    ) -> None:
        name = env_id.removeprefix("swm/")
        if not flatten and "Dict" not in name:
            name = name.replace("-v", "Dict-v")
        self.id = f"swm/{name}"  # type: ignore[misc]
        super().__init__(render_mode, init_value, resolution, kwargs)
        self.env_name = env_id
