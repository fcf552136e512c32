"""Videos of frames."""

from .video_utils import save_panel_videos, save_video

__all__ = ["save_panel_videos", "save_video"]
