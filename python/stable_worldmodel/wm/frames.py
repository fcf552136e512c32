"""`Frames`: frames of `uint8` as inputs of an image encoder."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

__all__ = ["Frames"]


class Frames(nn.Module):
    """Normalises frames of `uint8`; floating-point frames are taken as normalised already.

    Args:
        mean, std: Of each colour channel, for values in 0 ..= 1; ImageNet's by default.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, mean: Sequence[float] = (0.485, 0.456, 0.406), std: Sequence[float] = (0.229, 0.224, 0.225)) -> None:
        super().__init__()
        self.register_buffer("mean", torch.tensor(mean).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(std).view(3, 1, 1), persistent=False)

    def forward(self, frames: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
        """Frames `(.., 3, H, W)`, or of `uint8` and `(.., H, W, 3)`, to `(.., 3, H, W)`."""
        if frames.dtype != torch.uint8:
            return frames.to(dtype)
        if frames.shape[-1] == 3 and frames.shape[-3] != 3:
            frames = frames.movedim(-1, -3)
        return ((frames.float() / 255 - self.mean) / self.std).to(dtype)
