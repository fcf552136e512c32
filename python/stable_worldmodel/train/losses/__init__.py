"""The losses of a training step, as the engine computes them: a file for each kind of family."""

from __future__ import annotations

from collections.abc import Mapping

from .base import Losses
from .dino_wm import DinoWMLosses
from .gcrl import GCBCLosses, GCIQLLosses, GCIVLLosses
from .joint import LeWMLosses, PLDMLosses
from .tdmpc2 import TDMPC2Losses

__all__ = ["Losses", "losses_of"]

_LOSSES: Mapping[str, type[Losses]] = {
    "lewm": LeWMLosses,
    "pldm": PLDMLosses,
    "dino_wm": DinoWMLosses,
    "tdmpc2": TDMPC2Losses,
    "gcbc": GCBCLosses,
    "gcivl": GCIVLLosses,
    "gciql": GCIQLLosses,
}


def losses_of(family: str) -> type[Losses]:
    """The losses of a family.

    Raises:
        ValueError: If the family is trained by the engine only.
    """
    if family not in _LOSSES:
        known = ", ".join(_LOSSES)
        raise ValueError(f"the family {family!r} is not trained in torch ({known} are); train it with `swm train`")
    return _LOSSES[family]
