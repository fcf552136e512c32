"""The action spaces of one environment and of several together."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space

#: The most options of a choice.
_MOST_OPTIONS = 1 << 20

#: The attribute that marks the `Box` of environments whose actions are scalars: it has the shape of one action of as many
#: elements.
_OF_SCALARS = "_swm_of_scalars"


def batched(space: spaces.Space[Any], envs: int) -> spaces.Space[Any]:
    """The action space of `envs` environments, of which `single` finds that of one environment."""
    together = batch_space(space, envs)
    if isinstance(space, spaces.Box) and not space.shape:
        setattr(together, _OF_SCALARS, True)
    return together


def single(space: Any, envs: int) -> Any:
    """The action space of one environment, given that space or the batched space of `envs` environments.

    A `MultiDiscrete` of `envs` equal sizes is taken as the batched space of a `Discrete`, and a `Box` of whole numbers as that
    of a `MultiDiscrete` (of one choice, if they are scalars), as Gymnasium defines them. A `Box` with one axis is taken as that
    of one environment, unless `batched` made it.

    Raises:
        ValueError: When the rows of a space with several axes differ, which are those of equal environments.
    """
    if isinstance(space, spaces.Box) and (len(space.shape) > 1 or getattr(space, _OF_SCALARS, False)):
        low, high = _row(space, space.low), _row(space, space.high)
        if space.dtype.kind in "iu" and (np.subtract(high, low, dtype=np.float64) < _MOST_OPTIONS).all():
            start, high = np.atleast_1d(low).astype(np.int64), np.atleast_1d(high)
            return spaces.MultiDiscrete(high - start + 1, dtype=space.dtype.type, start=start)
        return spaces.Box(low, high, space.shape[1:], dtype=space.dtype.type)
    if isinstance(space, spaces.MultiDiscrete) and space.nvec.ndim > 1:
        return spaces.MultiDiscrete(_row(space, space.nvec), start=_row(space, space.start))
    if isinstance(space, spaces.MultiDiscrete) and len(space.nvec) == envs and (space.nvec == space.nvec[0]).all():
        return spaces.Discrete(space.nvec[0], start=space.start[0])
    return space


def _row(space: Any, rows: np.ndarray) -> np.ndarray:
    """What the rows of a space have in common."""
    if not (rows == rows[:1]).all():
        raise ValueError(
            f"action_space: {space} has rows that differ; expected the space of one environment with one axis, or the batched "
            "space of equal environments (gymnasium.vector.utils.batch_space)"
        )
    row: np.ndarray = rows[0]
    return row
