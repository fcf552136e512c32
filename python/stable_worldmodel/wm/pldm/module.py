"""The parts of a PLDM, which are those of a LeWM."""

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
    "Predictor",
    "Transformer",
    "detach_clone",
    "modulate",
]
