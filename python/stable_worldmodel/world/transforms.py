"""User-defined functions of the frames in infos."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

__all__ = ["FrameTransforms", "transformed"]


class FrameTransforms:
    """The functions that change `pixels` (with the camera views `pixels.NAME`) and `goal`."""

    def __init__(self, image: Callable[[Any], Any] | None, goal: Callable[[Any], Any] | None) -> None:
        for name, function in (("image_transform", image), ("goal_transform", goal)):
            if function is not None and not callable(function):
                raise TypeError(f"{name}: expected a function of a frame, got {type(function).__name__}")
        self.image, self.goal = image, goal

    def __bool__(self) -> bool:
        return self.image is not None or self.goal is not None

    def keys(self, infos: Mapping[str, Any]) -> list[str]:
        """The columns that change."""
        return [key for key in infos if self._function(key) is not None]

    def _function(self, key: str) -> Callable[[Any], Any] | None:
        if key == "goal":
            return self.goal
        return self.image if key == "pixels" or key.startswith("pixels.") else None

    def __call__(self, key: str, frames: np.ndarray) -> Any:
        """The results for frames `(B, 1, H, W, 3)` or `(B, H, W, 3)`, stacked with the leading axes of the frames."""
        function = self._function(key)
        assert function is not None
        lead = frames.shape[:-3]
        results = [transformed(function, frame) for frame in frames.reshape(-1, *frames.shape[-3:])]
        return _stacked(results, lead)


def transformed(function: Callable[[Any], Any], frame: np.ndarray) -> Any:
    """The result of a function of a frame; it gets a `PIL.Image` if Pillow is installed."""
    if importlib.util.find_spec("PIL") is None:
        return function(frame.copy())
    from PIL import Image

    return function(Image.fromarray(frame))


def _stacked(results: Iterable[Any], lead: tuple[int, ...]) -> Any:
    results = list(results)
    if hasattr(results[0], "detach"):
        import torch

        stacked: Any = torch.stack(results)
    else:
        stacked = np.stack([np.asarray(result) for result in results])
    return stacked.reshape(*lead, *stacked.shape[1:])
