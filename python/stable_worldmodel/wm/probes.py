"""Probes: modules that read a quantity from a model's latents, kept with the model."""

from __future__ import annotations

import os
from typing import Any

import torch
from torch import nn

from ._weights import check_archive

__all__ = ["attach_probe", "get_probe", "load_probe"]


def attach_probe(model: nn.Module, key: str, probe: nn.Module) -> None:
    """Makes a probe part of the model, by name; it moves and is saved with the model."""
    if not isinstance(probe, nn.Module):
        raise TypeError(f"probe: expected a torch.nn.Module, got {type(probe).__name__}")
    if not hasattr(model, "_probes"):
        model._probes = nn.ModuleDict()
    model._probes[key] = probe  # type: ignore[index, operator, assignment]


def get_probe(model: nn.Module, key: str) -> Any:
    """The probe with this name; `None` if the model has none."""
    probes: Any = getattr(model, "_probes", {})
    return probes[key] if key in probes else None


def load_probe(model: nn.Module, key: str, path: str | os.PathLike[str]) -> None:
    """Loads the weights of an attached probe, a state dict that `torch.save` wrote.

    Files that hold a module are refused, because reading them runs code of the file: save `probe.state_dict()`.
    """
    check_archive(path)
    weights = torch.load(path, map_location="cpu", weights_only=True)
    probe = get_probe(model, key)
    if probe is None:
        raise ValueError(f"load_probe: the model has no probe {key!r}; attach one first with attach_probe")
    probe.load_state_dict(weights)
