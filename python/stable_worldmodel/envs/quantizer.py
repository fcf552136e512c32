"""Continuous actions on a grid."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

__all__ = ["PolarQuantizer", "Quantizable"]


class Quantizable(Protocol):
    """A grid of actions."""

    @property
    def action_shape(self) -> tuple[int, ...]:
        """The number of indices along each axis."""
        ...

    def quantize(self, action: Any) -> Any:
        """The indices of an action's cell."""
        ...

    def dequantize(self, quantized_action: Any) -> Any:
        """The action at the centre of a cell."""
        ...


class PolarQuantizer:
    """Actions in a plane as a radius and an angle.

    Args:
        num_bins_radial: The number of radii.
        num_bins_angular: The number of angles.
        max_action_distance: The largest radius.
    """

    def __init__(self, num_bins_radial: int, num_bins_angular: int, max_action_distance: float) -> None:
        self.num_bins_radial, self.num_bins_angular = num_bins_radial, num_bins_angular
        self.max_action_distance = max_action_distance

    @property
    def action_shape(self) -> tuple[int, int]:
        """The number of radii and of angles."""
        return self.num_bins_radial, self.num_bins_angular

    def quantize(self, action: Any) -> np.ndarray:
        """The indices of radius and angle of an action `(2,)`; larger radii have the last index."""
        x, y = (float(value) for value in action)
        radius = np.hypot(x, y) / self.max_action_distance * self.num_bins_radial
        angle = np.arctan2(y, x) % (2 * np.pi) / (2 * np.pi) * self.num_bins_angular
        # A rounded action at the first angle of a sector is in it.
        cells = [min(int(radius), self.num_bins_radial - 1), int(angle + 1e-5) % self.num_bins_angular]
        return np.array(cells, np.int32)

    def dequantize(self, quantized_action: Any) -> np.ndarray:
        """The action `(2,)` at the middle radius of a cell and at its first angle."""
        ring, sector = (int(index) for index in quantized_action)
        radius = (ring + 0.5) * self.max_action_distance / self.num_bins_radial
        angle = 2 * np.pi * sector / self.num_bins_angular
        return np.array([radius * np.cos(angle), radius * np.sin(angle)], np.float32)
