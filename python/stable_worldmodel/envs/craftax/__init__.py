"""Craftax."""

from .craftax import (
    CraftaxClassicPixelsWrapper,
    CraftaxClassicSymbolicWrapper,
    CraftaxPixelsWrapper,
    CraftaxSymbolicWrapper,
    CraftaxWrapper,
)

__all__ = [
    "CraftaxClassicPixelsWrapper",
    "CraftaxClassicSymbolicWrapper",
    "CraftaxPixelsWrapper",
    "CraftaxSymbolicWrapper",
    "CraftaxWrapper",
]
