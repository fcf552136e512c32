"""The format `lance-video`."""

from ..format import FORMATS
from .named import LanceVideoDataset, LanceVideoWriter

__all__ = ["LanceVideo", "LanceVideoDataset", "LanceVideoWriter"]

LanceVideo = FORMATS["lance-video"]
