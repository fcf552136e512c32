"""`LeWM`: an image encoder and a predictor trained together, without collapse thanks to SIGReg (Maes et al., 2026)."""

from __future__ import annotations

from typing import Any

from torch import nn

from ..jepa import JEPA

__all__ = ["LeWM"]


class LeWM(JEPA):
    """LeWM: the loss is the squared error of the predicted latents plus `stable_worldmodel.wm.SIGReg` of all latents.

        emb = model.encode(batch)["emb"]  # (B, T, D)
        pred = model.predict(emb[:, :-1], batch["act_emb"][:, :-1])
        loss = (pred - emb[:, 1:]).square().mean() + weight * sigreg(emb.transpose(0, 1))

    Args:
        encoder, predictor, action_encoder, projector, pred_proj: As for `JEPA`.
        **kwargs: Ignored: settings of configurations that other versions wrote.
    """

    def __init__(
        self,
        encoder: nn.Module,
        predictor: nn.Module,
        action_encoder: nn.Module,
        projector: nn.Module | None = None,
        pred_proj: nn.Module | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(encoder, predictor, action_encoder, projector, pred_proj)
