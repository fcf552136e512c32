"""`DMControlWrapper`: the base class of the environments of the DeepMind Control suite."""

from __future__ import annotations

from typing import Any

from ..named import NamedEnv

__all__ = ["DMControlWrapper"]


class DMControlWrapper(NamedEnv):
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
