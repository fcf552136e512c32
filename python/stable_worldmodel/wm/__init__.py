"""World models: the engine's checkpoints, and the baselines as torch modules.

    swm.wm.train("lewm", data="rooms", out="lewm-rooms", preset="tiny")
    model = swm.wm.load("lewm-rooms")  # planned with in the engine, without Python
    twin = swm.wm.utils.load_pretrained("lewm-rooms")  # the same model as a torch module: a `LeWM`

`Model`, `load` and `train` need no torch. The torch modules are imported when they are first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from .engine import Model, load, train

if TYPE_CHECKING:
    from .gcrl import GCRL
    from .lewm import LeWM
    from .loss import PLDMLoss, SIGReg, TemporalStraighteningLoss, VCReg
    from .pldm import PLDM
    from .prejepa import PreJEPA
    from .tdmpc2 import TDMPC2, tdmpc2_forward
    from .utils import load_pretrained, save_pretrained

__all__ = [
    "GCRL",
    "PLDM",
    "TDMPC2",
    "LeWM",
    "Model",
    "PLDMLoss",
    "PreJEPA",
    "SIGReg",
    "TemporalStraighteningLoss",
    "VCReg",
    "load",
    "load_pretrained",
    "save_pretrained",
    "tdmpc2_forward",
    "train",
]

#: The modules of the names that need torch.
_TORCH = {
    "GCRL": "gcrl",
    "LeWM": "lewm",
    "PLDM": "pldm",
    "PLDMLoss": "loss",
    "PreJEPA": "prejepa",
    "SIGReg": "loss",
    "TDMPC2": "tdmpc2",
    "TemporalStraighteningLoss": "loss",
    "VCReg": "loss",
    "load_pretrained": "utils",
    "save_pretrained": "utils",
    "tdmpc2_forward": "tdmpc2",
}
_MODULES = ("encoders", "frames", "gcrl", "jepa", "lewm", "loss", "pldm", "prejepa", "probes", "tdmpc2", "utils")


def __getattr__(name: str) -> Any:
    if name in _TORCH:
        value = getattr(importlib.import_module(f"{__name__}.{_TORCH[name]}"), name)
        globals()[name] = value
        return value
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_MODULES})
