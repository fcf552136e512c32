"""Videos of frames."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .. import _engine, _files, _options

__all__ = ["save_panel_videos", "save_video"]


def save_video(path: str | os.PathLike[str], frames: Sequence[Any] | np.ndarray, fps: int = 15) -> None:
    """Writes frames as an MP4 video that browsers play; nothing without frames.

    Args:
        path: The file. Its folder is created; an existing file is replaced only if it is such a video.
        frames: Frames `(height, width, 3)` of `uint8`.
        fps: Frames per second.

    Raises:
        ValueError: If the path is a URI or has another suffix than `.mp4`, or the frames have another type or shape.
    """
    if len(frames) == 0:
        return
    path, fps = _files.local("path", path), int(_options.finite("fps", fps))
    if fps < 1:
        raise ValueError(f"fps: {fps}; expected at least 1 frame per second")
    if path.suffix.lower() != ".mp4":
        raise ValueError(f"path: {path}; videos are MP4 files: use a name that ends in .mp4")
    path.parent.mkdir(parents=True, exist_ok=True)
    stacked = np.stack([np.asarray(frame) for frame in frames])
    if stacked.dtype != np.uint8 or stacked.ndim != 4:
        raise ValueError(f"save_video: expected frames (height, width, 3) of uint8, got {stacked.dtype} {stacked.shape[1:]}")
    _engine.write_video(str(path), np.ascontiguousarray(stacked), fps)


def save_panel_videos(
    video_dir: str | os.PathLike[str], panels: Mapping[str, Sequence[Any] | np.ndarray], fps: int = 15
) -> None:
    """Writes a video `env_INDEX.mp4` of each environment, with labelled panels side by side.

    Args:
        video_dir: The folder of the videos.
        panels: For each label one entry for each environment: frames `(T, height, width, 3)`, or one frame
            `(height, width, 3)` that is shown all the time. All frames have the same size. A shorter panel keeps its last
            frame.
        fps: Frames per second.

    Raises:
        ValueError: If the folder is a URI, or there are no panels, or panels of other numbers of environments.
    """
    folder, labels = _files.local("video_dir", video_dir), list(panels)
    counts = {label: len(panels[label]) for label in labels}
    if len(set(counts.values())) != 1:
        raise ValueError(f"panels: they have the environments {counts}; give at least one panel, each with the same number")
    for env in range(len(panels[labels[0]])):
        videos = [np.asarray(panels[label][env]) for label in labels]
        videos = [video if video.ndim == 4 else video[None] for video in videos]
        count = max(len(video) for video in videos)
        frames = [_panel(labels, [video[min(step, len(video) - 1)] for video in videos]) for step in range(count)]
        save_video(folder / f"env_{env}.mp4", frames, fps)


def _panel(labels: Sequence[str], frames: Sequence[np.ndarray]) -> np.ndarray:
    """One frame: the given frames beside each other on white, each above its label."""
    try:
        from PIL import Image, ImageDraw
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{error}; labels of panels need Pillow: pip install pillow") from error

    height, width = frames[0].shape[:2]
    margin, line = max(8, width // 16), max(16, width // 10)
    size = (margin + len(frames) * (width + margin), height + 3 * margin + line)
    canvas = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(canvas)
    for column, (label, frame) in enumerate(zip(labels, frames, strict=True)):
        left = margin + column * (width + margin)
        canvas.paste(Image.fromarray(frame), (left, margin))
        draw.text((left + width / 2, height + 2 * margin), label, fill="gray", anchor="ma")
    return np.array(canvas)
