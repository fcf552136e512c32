"""`DiscreteSolver`: what the solvers for discrete actions have in common."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

from .engine import EngineSolver

__all__ = ["DiscreteSolver"]


class DiscreteSolver(EngineSolver):
    """Base class of the solvers for discrete actions, which plan one-hot vectors of the options."""

    @property
    def action_block(self) -> int:
        """Environment steps in one model step."""
        return int(self._configured().action_block)

    @property
    def base_simplex_dim(self) -> int:
        """The number of options of one environment step."""
        return self.action_dim // self.action_block

    @property
    def action_simplex_dim(self) -> int:
        """The number of options of one model step: the dimension of its one-hot vectors."""
        return self.action_dim

    def _options(self) -> list[int]:
        """The number of options of every choice of a model step."""
        space: Any = self._space()
        options = [space.n] if isinstance(space, spaces.Discrete) else np.asarray(space.nvec).reshape(-1).tolist()
        return [int(n) for n in options] * self.action_block

    def _uniform(self) -> np.ndarray:
        """The probabilities `(action_dim,)` of options that are equally likely."""
        return np.concatenate([np.full(n, 1 / n, np.float32) for n in self._options()])

    def _one_hot(self, indices: Any) -> np.ndarray:
        """The one-hot vectors `(B, T, action_dim)` of the indices of options `(B, T, choices)`, or `(B, T)` of one choice."""
        chosen = np.asarray(indices.detach().cpu() if hasattr(indices, "detach") else indices).astype(np.int64)
        options = self._options()
        if chosen.ndim == 2 and len(options) == 1:
            chosen = chosen[..., None]
        if chosen.ndim != 3 or chosen.shape[-1] != len(options):
            raise ValueError(f"init_action: got indices of shape {chosen.shape}, expected (B, T, {len(options)})")
        vectors = [np.eye(n, dtype=np.float32)[chosen[..., choice]] for choice, n in enumerate(options)]
        return np.concatenate(vectors, -1)
