"""The format `video`."""

from ..format import FORMATS
from .named import VideoDataset, VideoWriter

__all__ = ["Video", "VideoDataset", "VideoWriter"]

Video = FORMATS["video"]
