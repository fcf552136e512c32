"""`GymControlWrapper`: the base class of the classic control environments."""

from __future__ import annotations

from typing import Any, ClassVar

from ..named import NamedEnv

__all__ = ["GymControlWrapper"]


class GymControlWrapper(NamedEnv):
    """A classic control environment of the engine, with factors of variation.

    Args:
        env_id: Gymnasium's id of the environment.
        render_mode: `"rgb_array"` or `None`.
        **kwargs: Options of the environment.
    """

    #: Gymnasium's id.
    gym_id: ClassVar[str]
    #: The ids of the engine, by Gymnasium's id.
    _IDS: ClassVar[dict[str, str]] = {
        "Acrobot-v1": "swm/AcrobotControl-v1",
        "CartPole-v1": "swm/CartPoleControl-v1",
        "MountainCar-v0": "swm/MountainCarControl-v0",
        "MountainCarContinuous-v0": "swm/MountainCarContinuousControl-v0",
        "Pendulum-v1": "swm/PendulumControl-v1",
    }

    def __init__(self, env_id: str, render_mode: str | None = None, **kwargs: Any) -> None:
        if env_id not in self._IDS:
            raise ValueError(f"env_id: {env_id!r}; expected one of {', '.join(self._IDS)}")
        self.id = self._IDS[env_id]  # type: ignore[misc]
        super().__init__(render_mode, options=kwargs)
        self.env_name = env_id
