"""Our own models: checkpoints of LeWM, PLDM, DINO-WM, TD-MPC2, GCBC, GCIVL, GCIQL, SAC.

    model = swm.wm.load("lewm-rooms")            # a name under $STABLEWM_HOME/checkpoints, or a path
    solver = swm.solver.CEMSolver(model)         # planning runs in the engine, without Python
    swm.wm.train("lewm", data="rooms", out="lewm-rooms", preset="tiny")
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from . import _engine
from .planning import has_torch
from .solver import now

__all__ = ["Model", "load", "load_pretrained", "train"]


class Model:
    """A checkpoint: to plan in (`get_cost`), or to act with (`swm.policy.FeedForwardPolicy`).

    Args:
        name: A name under `$STABLEWM_HOME/checkpoints`, or a path.
        device: `cpu`, or a GPU where the engine was built with one.
        objective: What plans are for besides the model's own cost: a dict as `swm eval --objective` reads.
    """

    def __init__(self, name: str, device: str = "cpu", objective: dict[str, Any] | None = None) -> None:
        self._engine_model = _engine.Model(str(name), device, json.dumps(objective))
        #: What it is: `family`, `env`, `image`, `action_block`, `history`, `config`, `weights` and more.
        self.card: dict[str, Any] = json.loads(self._engine_model.card)

    @property
    def path(self) -> str:
        """Where it is."""
        return self._engine_model.path

    @property
    def action_block(self) -> int:
        """Environment steps in one model step."""
        return int(self.card["action_block"])

    @property
    def _engine_policy(self) -> str:
        return self.path

    def get_cost(self, info_dict: dict[str, Any], action_candidates: Any) -> Any:
        """What candidates `(B, S, H, A)`, in the model's units, cost: `(B, S)`. torch in, torch out; numpy in, numpy out.

        Infos are `(B, T, ..)`, or `(B, S, T, ..)`: the same for every candidate. Pictures, `(height, width, 3)` bytes, show
        which.
        """
        torch_in = hasattr(action_candidates, "detach")
        candidates = action_candidates.detach().cpu().numpy() if torch_in else np.asarray(action_candidates)
        candidates = np.ascontiguousarray(candidates, dtype=np.float32)
        if candidates.ndim != 4:
            raise ValueError(f"action_candidates: got shape {candidates.shape}, expected (B, S, H, A)")
        given = {
            key: value
            for key, value in info_dict.items()
            if not isinstance(value, (list, str, Mapping)) and not key.startswith("_")
        }
        pictures = [value.ndim for key, value in given.items() if key in ("pixels", "goal")]
        # Infos repeated for every candidate say nothing new.
        repeated = bool(pictures) and max(pictures) == 6
        infos = {key: now(value[:, 0] if repeated else value) for key, value in given.items()}
        costs = self._engine_model.cost(infos, candidates)
        if torch_in and has_torch():
            import torch

            return torch.from_numpy(costs).to(action_candidates.device)
        return costs

    def __repr__(self) -> str:
        return f"Model({self.card['family']}, {self.path!r})"


def load(name: str, device: str = "cpu", **kwargs: Any) -> Model:
    """A checkpoint by name or path."""
    return Model(name, device, **kwargs)


load_pretrained = load


def train(
    model: str,
    *,
    data: str | None = None,
    env: str | None = None,
    out: str | None = None,
    preset: str | None = None,
    device: str = "cpu",
    **overrides: Any,
) -> str:
    """Trains a model, as `swm train` does; returns the checkpoint's place.

    Args:
        model: A family, such as `lewm` (`swm models` lists them).
        data: A dataset to learn from, or `env`: an environment to play in.
        out: The checkpoint's name or path.
        preset: A configuration; the first one of the family for `None`.
        **overrides: What differs from it, with `__` for dots: `train__steps=1000`.
    """
    words = ["swm", "train", model]
    for flag, value in (("--data", data), ("--env", env), ("--output", out), ("--preset", preset), ("--device", device)):
        if value is not None:
            words += [flag, str(value)]
    words += [f"{key.replace('__', '.')}={value}" for key, value in overrides.items()]
    code = _engine.command(words)
    if code == 130:
        raise KeyboardInterrupt
    if code:
        raise RuntimeError(f"swm train ended with code {code}; what it printed says why")
    return str(out)
