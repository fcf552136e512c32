"""LeWM."""

from .lewm import LeWM

__all__ = ["LeWM"]
