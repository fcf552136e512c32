"""`DiscreteSolver`: what the solvers for discrete actions have in common."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

from ..._action_spaces import single
from .engine import EngineSolver
from .hooks import view

__all__ = ["DiscreteSolver"]


class SpaceError(ValueError, AssertionError):
    """A solver does not support the action space."""


class DiscreteSolver(EngineSolver):
    """Base class of the solvers for discrete actions.

    The cost gets one-hot vectors of the options, `(B, S, horizon, action_simplex_dim)`. `solve` returns the indices of
    the options, `(B, horizon, choices)` of int64.
    """

    def configure(self, *, action_space: spaces.Space[Any], n_envs: int, config: Any) -> None:
        """See `Solver.configure`; the space is `Discrete` or `MultiDiscrete`, or one of several environments."""
        if not isinstance(single(action_space, n_envs), (spaces.Discrete, spaces.MultiDiscrete)):
            raise SpaceError(f"{type(self).__name__} plans discrete actions, got the action space {action_space}")
        super().configure(action_space=action_space, n_envs=n_envs, config=config)

    @property
    def action_dim(self) -> int:
        """The number of choices of one model step."""
        return len(self._options())

    @property
    def action_block(self) -> int:
        """Environment steps in one model step."""
        return int(self._configured().action_block)

    @property
    def base_simplex_dim(self) -> int:
        """The number of options of one environment step."""
        return self._plan_dim // self.action_block

    @property
    def action_simplex_dim(self) -> int:
        """The number of options of one model step: the dimension of its one-hot vectors."""
        return self._plan_dim

    def solve(self, info_dict: dict[str, Any], init_action: Any = None) -> dict[str, Any]:
        """See `EngineSolver.solve`. `init_action` has one-hot vectors, or the indices of options as `actions` of a result."""
        return super().solve(info_dict, self._vectors(init_action))

    def _outputs(self, result: dict[str, Any], watched: Any) -> dict[str, Any]:
        """The plan as the indices of options."""
        vectors, start = np.asarray(result["actions"]), self._start()
        ends = np.cumsum(self._options())
        chosen = [vectors[..., end - n : end].argmax(-1) for end, n in zip(ends, self._options(), strict=True)]
        return {"actions": view(np.stack(chosen, -1).astype(np.int64) + start)}

    def _vectors(self, init: Any, indices: bool = False) -> Any:
        """Initial actions as one-hot vectors; indices are recognised by their number if it is not that of the options."""
        if init is None or (not indices and init.shape[-1] != self.action_dim) or self.action_dim == self._plan_dim:
            return init
        return self._one_hot(init)

    def _start(self) -> np.ndarray:
        """The action of the first option, for every choice of a model step."""
        space: Any = self._space()
        start = np.zeros(len(self._options()) // self.action_block, np.int64) + np.reshape(getattr(space, "start", 0), -1)
        return np.tile(start, self.action_block)

    def _options(self) -> list[int]:
        """The number of options of every choice of a model step."""
        space: Any = self._space()
        options = [space.n] if isinstance(space, spaces.Discrete) else np.asarray(space.nvec).reshape(-1).tolist()
        return [int(n) for n in options] * self.action_block

    def _uniform(self) -> np.ndarray:
        """The probabilities `(action_dim,)` of options that are equally likely."""
        return np.concatenate([np.full(n, 1 / n, np.float32) for n in self._options()])

    def _one_hot(self, indices: Any) -> np.ndarray:
        """The one-hot vectors `(B, T, dim)` of the indices of options `(B, T, choices)`, or `(B, T)` of one choice.

        An index that no option has, such as -1, gives zeros: nothing is known about the choice.
        """
        chosen = np.asarray(indices.detach().cpu() if hasattr(indices, "detach") else indices).astype(np.int64)
        options = self._options()
        if chosen.ndim == 2 and len(options) == 1:
            chosen = chosen[..., None]
        if chosen.ndim != 3 or chosen.shape[-1] != len(options):
            raise ValueError(f"init_action: got indices of shape {chosen.shape}, expected (B, T, {len(options)})")
        chosen = chosen - self._start()
        vectors = [chosen[..., choice, None] == np.arange(n) for choice, n in enumerate(options)]
        return np.concatenate(vectors, -1).astype(np.float32)
