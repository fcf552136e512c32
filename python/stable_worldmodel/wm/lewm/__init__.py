"""LeWM."""

from . import module as module
from .lewm import LeWM

__all__ = ["LeWM"]
