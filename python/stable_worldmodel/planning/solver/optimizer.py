"""Optimizers of torch as settings of the engine."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

__all__ = ["optimizer"]


def optimizer(kind: Any, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The engine's setting for an optimizer of torch."""
    kind = (kind if isinstance(kind, str) else kind.__name__).lower()
    if kind not in ("sgd", "adam"):
        raise ValueError(f"optimizer_cls: expected SGD or Adam, got {kind}")
    given = dict(settings)
    out: dict[str, Any] = {"kind": kind, "step": float(given.pop("lr", 1.0 if kind == "sgd" else 1e-3))}
    if kind == "adam":
        betas = given.pop("betas", (0.9, 0.999))
        out |= {"beta1": float(betas[0]), "beta2": float(betas[1]), "epsilon": float(given.pop("eps", 1e-8))}
    if given:
        raise ValueError(f"optimizer_kwargs: the engine's {kind} does not support {', '.join(given)}; remove them")
    return out
