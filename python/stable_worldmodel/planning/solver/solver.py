"""`Solver`: the interface of solvers."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

from gymnasium import spaces

__all__ = ["Solver"]


@runtime_checkable
class Solver(Protocol):
    """What `WorldModelPolicy` requires of a solver. It calls `configure` and `solve`; the properties are for users."""

    def configure(self, *, action_space: spaces.Space[Any], n_envs: int, config: Any) -> None:
        """Sets the batched action space, the number of environments and the `PlanConfig`."""
        ...

    def solve(self, info_dict: dict[str, Any], init_action: Any = None) -> dict[str, Any]:
        """Plans for every row of `info_dict` `(B, T, ..)`; returns a dict with `actions` `(B, horizon, action_dim)`."""
        ...

    @property
    def n_envs(self) -> int:
        """The number of environments."""
        ...

    @property
    def horizon(self) -> int:
        """The number of model steps in a plan."""
        ...

    @property
    def action_dim(self) -> int:
        """The dimension of one model step."""
        ...
