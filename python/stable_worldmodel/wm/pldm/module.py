"""The parts of a PLDM: those of a LeWM, and inverse dynamics."""

import torch
from torch import Tensor, nn

from ..lewm.module import (
    MLP,
    Attention,
    Block,
    ConditionalBlock,
    Embedder,
    FeedForward,
    Predictor,
    Transformer,
    detach_clone,
    modulate,
)

__all__ = [
    "MLP",
    "Attention",
    "Block",
    "ConditionalBlock",
    "Embedder",
    "FeedForward",
    "InverseDynamics",
    "Predictor",
    "Transformer",
    "detach_clone",
    "modulate",
]


class InverseDynamics(nn.Module):
    """Predicts the actions between successive latents, for the loss."""

    def __init__(self, latent: int, hidden: int, action_dim: int) -> None:
        super().__init__()
        first, last = nn.Linear(2 * latent, hidden), nn.Linear(hidden, action_dim)
        self.net = nn.Sequential(first, nn.LayerNorm(hidden), nn.GELU(), last)

    def forward(self, z: Tensor) -> Tensor:
        """Latents `(B, T, D)` to the actions `(B, T - 1, A)` between them."""
        # As in the published code, the later latent of a pair comes first.
        return self.net(torch.cat([z[:, 1:], z[:, :-1]], -1))  # type: ignore[no-any-return]
