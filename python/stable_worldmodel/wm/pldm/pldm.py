"""`PLDM`: planning with a latent dynamics model (Sobal et al., 2025)."""

from __future__ import annotations

from ..jepa import JEPA

__all__ = ["PLDM"]


class PLDM(JEPA):
    """PLDM: the loss is the squared error of the predicted latents plus the terms of `stable_worldmodel.wm.PLDMLoss`.

    The arguments are those of `JEPA`. A module of a checkpoint of the engine also has `idm`, the inverse dynamics of the loss.
    """

    def _checkpoint_name(self, name: str) -> str:
        return name if name.startswith("idm.") else f"model.{name}"
