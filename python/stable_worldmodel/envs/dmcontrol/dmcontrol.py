"""`DMControlWrapper`: the base class of the environments of the DeepMind Control suite."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..mujoco import MujocoEnv

__all__ = ["DMControlWrapper", "get_obs_shape"]


def get_obs_shape(env: Any) -> tuple[int]:
    """The shape of the observation of an environment of dm_control, whose arrays are joined.

    Args:
        env: The environment, with `observation_spec()`.
    """
    sizes = (int(np.prod(getattr(spec, "shape", ()))) for spec in env.observation_spec().values())
    return (sum(sizes),)


class DMControlWrapper(MujocoEnv):
    """An environment of the DeepMind Control suite in the engine.

    Args:
        task: The task; the environment's own for `None`.
        seed: The seed of the first episode whose reset has none.
        environment_kwargs: Must be empty: the engine creates the environment.
        render_mode: `"rgb_array"` or `None`.
    """

    def __init__(
        self,
        task: str | None = None,
        seed: int | None = None,
        environment_kwargs: Any = None,
        render_mode: str | None = None,
    ) -> None:
        self._refuse(environment_kwargs=(environment_kwargs or None, None))
        super().__init__(render_mode, options={"task": task})
        self._first_seed = seed

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode."""
        seed, self._first_seed = (self._first_seed if seed is None else seed), None
        return super().reset(seed=seed, options=options)

    @property
    def info(self) -> dict[str, Any]:
        """The infos of the current state."""
        return self._get_info()

    def set_gravity(self, gravity: Any) -> None:
        """Sets the factors of gravity `(3,)`, in m/s², for the rest of the episode; the state stays as it is.

        Raises:
            ValueError: If the environment has no such factors, or a value is out of their range.
        """
        given = np.asarray(gravity, np.float64).reshape(-1)
        keys = ["gravity.x", "gravity.y", "gravity.z"]
        if "gravity.z" not in self._described["variation"]:
            raise ValueError(f"set_gravity: {self.id} has no factors of gravity")
        if len(given) != 3:
            raise ValueError(f"set_gravity: {gravity!r}; expected three values")
        for key, value in zip(keys, given, strict=True):
            factor = self.variation_space.find(key)
            factor.set_value(np.full(factor.shape, value, factor.dtype))
        self.apply_runtime_variations()

    def render(self, width: int = 224, height: int = 224, camera_id: int | str | None = None) -> np.ndarray | None:
        """The frame, `(height, width, 3)` of `uint8`; `None` without a render mode.

        Args:
            width, height: The size in pixels.
            camera_id: The index or the name of a camera (`swm envs ID` lists them); the environment's own for `None`.
        """
        if self.render_mode is None:
            return None
        if camera_id is None:
            return self._env.render(int(height), int(width), False)
        cameras: list[str] = self._described["cameras"]
        if not (camera_id in cameras if isinstance(camera_id, str) else -1 <= camera_id < len(cameras)):
            raise ValueError(f"camera_id: {camera_id}; expected an index below {len(cameras)}, or one of {', '.join(cameras)}")
        name = camera_id if isinstance(camera_id, str) else cameras[camera_id]
        return self._env.render_view(name, int(height), int(width))
