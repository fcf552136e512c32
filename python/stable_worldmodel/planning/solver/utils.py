"""The actions at which a search starts."""

from __future__ import annotations

from typing import Any

__all__ = ["prepare_init_action"]


def prepare_init_action(
    model: Any,
    info_dict: dict[str, Any],
    init_action: Any,
    horizon: int,
    n_envs: int,
    action_dim: int,
    device: Any = None,
) -> Any:
    """The initial actions, extended to the horizon.

    A model with a policy (`get_action(info, horizon=, prefix_actions=)`) provides the missing steps; otherwise they are
    zero.

    Args:
        model: The model, or any other object.
        info_dict: The infos `(n_envs, T, ..)`.
        init_action: A tensor `(n_envs, at most horizon, action_dim)`, or `None`.
        horizon: The number of model steps.
        n_envs: The number of environments.
        action_dim: The dimension of one model step.
        device: The device of the result; that of `init_action`, or the CPU, for `None`.

    Returns:
        A tensor `(n_envs, horizon, action_dim)`.
    """
    import torch

    known = 0
    if init_action is not None:
        if init_action.shape[0] != n_envs or init_action.shape[2] != action_dim:
            shape = tuple(init_action.shape)
            raise ValueError(f"init_action: got shape {shape}, expected ({n_envs}, at most {horizon}, {action_dim})")
        known = init_action.shape[1]
        device = init_action.device if device is None else device
        init_action = init_action.to(device)
    if known >= horizon:
        return init_action
    if callable(getattr(model, "get_action", None)):
        with torch.no_grad():
            rest = model.get_action(info_dict, horizon=horizon - known, prefix_actions=init_action)
        rest = rest if device is None else rest.to(device)
    else:
        rest = torch.zeros(n_envs, horizon - known, action_dim, device=device)
    return rest if init_action is None else torch.cat([init_action.to(rest.device), rest], 1)
