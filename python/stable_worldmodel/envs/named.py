"""`NamedEnv` and `ScriptedExpert`: the base classes of the environments and experts of this package's modules."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from ..policy import ExpertPolicy
from .native import NativeEnv

__all__ = ["NamedEnv", "ScriptedExpert"]


class NamedEnv(NativeEnv):
    """A native environment whose id is that of the class.

    Args:
        render_mode: `"rgb_array"` or `None`.
        init_value: Values of factors, by dot key or nested, for episodes that do not vary them.
        resolution: Side of the frames in pixels.
        options: Options of the environment; `None` is left out.
    """

    #: The id of the environment.
    id: ClassVar[str]

    def __init__(
        self,
        render_mode: str | None = "rgb_array",
        init_value: Mapping[str, Any] | None = None,
        resolution: int = 224,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        given = {name: value for name, value in (options or {}).items() if value is not None}
        super().__init__(self.id, render_mode=render_mode, image_shape=(resolution, resolution), **given)
        #: The name in infos, such as `PushT` or `Walker`.
        self.env_name = self.id.rpartition("/")[2].partition("-")[0].removeprefix("OGB").removesuffix("DMControl")
        self._defaults = _flat(init_value or {})
        for key in self._defaults:
            self._variation_space.find(key)

    def reset(self, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode. Factors, start and goal depend only on the seed, the options and `init_value`."""
        given = dict(options or {})
        if self._defaults:
            varied = given.get("variation")
            names = list(self._described.get("default_variations", ())) if varied is None else varied
            names = [names] if isinstance(names, str) else list(names)
            chosen = [key for key in self._defaults if not _is_in(key, names)]
            values = {key: self._defaults[key] for key in chosen}
            given["variation_values"] = {**values, **(given.get("variation_values") or {})}
        return super().reset(seed=seed, options=given)

    def _info(self, columns: dict[str, Any], success: bool) -> dict[str, Any]:
        return {"env_name": self.env_name, **super()._info(columns, success)}

    @classmethod
    def _refuse(cls, **settings: tuple[Any, Any]) -> None:
        """Raises `ValueError` for settings, given as pairs of value and default, that have another value."""
        for name, (value, default) in settings.items():
            if value != default:
                raise ValueError(f"{cls.__name__}: {name}={value!r} is not supported; leave it at {default!r}")


def _flat(values: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in values.items():
        found.update(_flat(value, f"{before}{key}.") if isinstance(value, Mapping) else {f"{before}{key}": value})
    return found


def _is_in(key: str, names: list[str]) -> bool:
    return any(name == "all" or key == name or key.startswith(f"{name}.") for name in names)


class ScriptedExpert(ExpertPolicy):
    """An expert of the environments of one module.

    Args:
        action_noise: The standard deviation of the noise that `World.collect` adds to every action. Evaluations play the
            expert without noise.
        seed: Combined with the seed of each episode.
    """

    #: The name of the expert in the engine.
    expert: ClassVar[str] = "expert"

    def __init__(self, action_noise: float = 0.0, seed: int | None = None, **kwargs: Any) -> None:
        super().__init__(self.expert, seed, **kwargs)
        self.action_noise = float(action_noise)

    def get_action(self, info_dict: Any, **kwargs: Any) -> np.ndarray:  # type: ignore[override]
        """The actions for the current infos of the world; the argument is ignored."""
        return super().get_action(info_dict)

    def set_seed(self, seed: int | None) -> None:
        """Sets the policy's seed, which is combined with the seed of each episode."""
        self.seed = seed
        if self.env is not None:
            self.env._world._drop_actor(self)

    @classmethod
    def _refuse(cls, **settings: tuple[Any, Any]) -> None:
        """Raises `ValueError` for settings, given as pairs of value and default, that have another value."""
        for name, (value, default) in settings.items():
            if value != default:
                raise ValueError(f"{cls.__name__}: {name}={value!r} is not supported; leave it at {default!r}")
