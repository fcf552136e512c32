"""The losses of DINO-WM (Zhou et al., 2025, section 3): the error of predicted patches, whose encoder is frozen.

Shapes: N clips of this rank, T frames, P patches of a frame, D features of a patch.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from ...wm.prejepa import PreJEPA
from .base import Losses, windows

__all__ = ["DinoWMLosses"]


class DinoWMLosses(Losses):
    """The squared error of the next frame's image features and columns; actions are inputs only.

    A decoder learns to reconstruct the frames from the encoder's features, which does not change the predictor.
    """

    model: PreJEPA

    def compile(self, compiled: Callable[[Any], Any]) -> None:
        self._encode, self._predict = compiled(self.model.encode), compiled(self.model.predict)
        columns = ["columns"] if any(name != "action" for name in self.model.extra_encoders) else []
        decoder = [] if self.model.decoder is None else ["reconstruction"]
        self.names = ("loss", "prediction", "pixels", *columns, *decoder)

    def train_mode(self) -> None:
        super().train_mode()
        self.model.backbone.eval()

    def __call__(self, batch: Mapping[str, Tensor], sizes: Sequence[int]) -> dict[str, Tensor]:
        if not len(batch["action"]):
            return {}
        model = self.model
        columns = {name: batch[name] for name in model.extra_encoders if name != "action"}
        with self.precision():
            info = self._encode({"pixels": batch["pixels"], "action": self.actions(batch), **columns})
            embedding = info["emb"]
            history = min(model.history_size, embedding.shape[1] - 1)
            predicted = self._predict(windows(embedding, history, 0))
        error = (predicted.float() - windows(embedding.detach(), history, 1).float()).square()
        image, columns_error = self._split(error)
        errors = [image.flatten(), *(part.flatten() for part in columns_error)]
        terms = {"prediction": torch.cat(errors).mean(), "pixels": image.mean()}
        loss = terms["prediction"]
        if columns_error:
            terms["columns"] = torch.cat(errors[1:]).mean()
        if model.decoder is not None:
            with self.precision():
                images = model.decode(info)["reconstructed_pixels"]
            terms["reconstruction"] = (images.float() - model.frames(batch["pixels"])).square().mean()
            loss = loss + terms["reconstruction"]
        return {"loss": loss, **terms}

    def _split(self, error: Tensor) -> tuple[Tensor, list[Tensor]]:
        """The errors `(.., P, D)` of the image features, and of each column but the action."""
        encoders = self.model.extra_encoders
        sizes = [encoders[name].emb_dim for name in encoders]
        image, *columns = error.split([error.shape[-1] - sum(sizes), *sizes], -1)
        return image, [column for name, column in zip(encoders, columns, strict=True) if name != "action"]
