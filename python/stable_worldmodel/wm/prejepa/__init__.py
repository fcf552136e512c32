"""DINO-WM."""

from .prejepa import PreJEPA

__all__ = ["PreJEPA"]
