"""The environments of Craftax as classes (`pip install "stable-worldmodel-rs[craftax]"`), which run in this interpreter."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np

from ... import _engine

__all__ = [
    "CraftaxClassicPixelsWrapper",
    "CraftaxClassicSymbolicWrapper",
    "CraftaxPixelsWrapper",
    "CraftaxSymbolicWrapper",
    "CraftaxWrapper",
]


class CraftaxWrapper(gymnasium.Env[np.ndarray, int]):
    """An environment of Craftax, without a time limit.

    Args:
        env_name: Craftax's name, such as `Craftax-Symbolic-v1`.
        obs_shape: The shape of an observation.
        seed: The seed of the first episode whose reset has none.
        backend: Must be `None`: JAX chooses the device.
        render_mode: `"rgb_array"` or `None`.

    Raises:
        ModuleNotFoundError: If Craftax is not installed.
        ValueError: If there is no such environment, or its observations have another shape.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}

    def __init__(
        self,
        env_name: str,
        obs_shape: Sequence[int],
        seed: int = 0,
        backend: str | None = None,
        render_mode: str | None = None,
    ) -> None:
        if backend is not None:
            raise ValueError(f"{type(self).__name__}: backend={backend!r} is not supported; set JAX_PLATFORMS instead")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode: expected 'rgb_array' or None, got {render_mode!r}")
        try:
            # Loads the module `swm_craftax` of the engine.
            _engine.bridge(True)
            importlib.import_module("swm_craftax").register()
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(f"{error}; install it with: pip install 'stable-worldmodel-rs[craftax]'") from error
        # `Craftax-Classic-Pixels-v1` is `swm/CraftaxClassicPixels-v1`.
        *words, version = env_name.split("-")
        id = f"swm/{''.join(words)}-{version}"
        if id not in gymnasium.registry:
            known = ", ".join(known for known in gymnasium.registry if known.startswith("swm/Craftax"))
            raise ValueError(f"env_name: {env_name!r} is unknown; the environments are {known}")
        self._name = env_name
        self._env: Any = gymnasium.make(id, disable_env_checker=True).unwrapped
        self.observation_space, self.action_space = self._env.observation_space, self._env.action_space
        if tuple(obs_shape) != self.observation_space.shape:
            raise ValueError(f"obs_shape: {tuple(obs_shape)}; observations have the shape {self.observation_space.shape}")
        self.render_mode, self.variation_space = render_mode, None
        #: The name in infos: Craftax's, or that of a derived class.
        self.env_name = env_name if type(self) is CraftaxWrapper else type(self).__name__
        self._first_seed: int | None = seed
        self._last: dict[str, Any] = {}

    @property
    def craftax_env(self) -> Any:
        """An environment of Craftax with the same rules: a pure function of keys, states and actions."""
        from craftax.craftax_env import make_craftax_env_from_name

        return make_craftax_env_from_name(self._name, auto_reset=False)

    @property
    def info(self) -> dict[str, Any]:
        """The infos of the last step, and `env_name`."""
        return {"env_name": self.env_name, **self._last}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode."""
        super().reset(seed=seed)
        seed, self._first_seed = (self._first_seed if seed is None else seed), None
        observation, _ = self._env.reset(seed=seed)
        self._last = {}
        return observation, self.info

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Applies an action."""
        observation, reward, terminated, truncated, info = self._env.step(action)
        self._last = {key: np.asarray(value) for key, value in info.items()}
        return observation, reward, terminated, truncated, self.info

    def render(self) -> np.ndarray | None:
        """The frame, `(height, width, 3)` of `uint8`, also of symbolic observations; `None` without a render mode."""
        return self._env.render() if self.render_mode == "rgb_array" else None


class CraftaxPixelsWrapper(CraftaxWrapper):
    """Craftax with frames as observations."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("Craftax-Pixels-v1", (130, 110, 3), **kwargs)


class CraftaxSymbolicWrapper(CraftaxWrapper):
    """Craftax with symbolic observations."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("Craftax-Symbolic-v1", (8268,), **kwargs)


class CraftaxClassicPixelsWrapper(CraftaxWrapper):
    """Craftax-Classic with frames as observations."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("Craftax-Classic-Pixels-v1", (63, 63, 3), **kwargs)


class CraftaxClassicSymbolicWrapper(CraftaxWrapper):
    """Craftax-Classic with symbolic observations."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("Craftax-Classic-Symbolic-v1", (1345,), **kwargs)
