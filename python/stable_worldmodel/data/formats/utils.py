"""What formats have in common."""

from __future__ import annotations

from typing import Any

from .._tensors import is_image, to_numpy

__all__ = ["is_image_column"]


def is_image_column(vals: Any) -> bool:
    """Whether the steps of a column are images: `uint8`, `(H, W, 1)` or `(H, W, 3)`."""
    if len(vals) == 0:
        return False
    first = to_numpy(vals[0])
    return first.dtype.name == "uint8" and is_image(first.shape)
