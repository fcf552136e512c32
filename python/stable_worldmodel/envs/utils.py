"""Helpers for programs that draw simulations of pymunk with pygame, and the rotation of OGBench's cameras.

pygame, pymunk and shapely are imported by the helpers that need them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

__all__ = [
    "DrawOptions",
    "from_pygame",
    "get_mouse_pos",
    "light_color",
    "perturb_camera_angle",
    "positive_y_is_up",
    "pymunk_to_shapely",
    "to_pygame",
]

#: Whether the y axis of a simulation points up. Rows of a surface count downwards.
positive_y_is_up = False


def to_pygame(p: Sequence[float], surface: Any) -> tuple[int, int]:
    """The pixel of a surface at a point of the simulation."""
    x, y = round(p[0]), round(p[1])
    return (x, surface.get_height() - y) if positive_y_is_up else (x, y)


def from_pygame(p: Sequence[float], surface: Any) -> tuple[int, int]:
    """The point of the simulation at a pixel of a surface."""
    return to_pygame(p, surface)


def get_mouse_pos(surface: Any) -> tuple[int, int]:
    """The point of the simulation under the mouse."""
    import pygame

    return from_pygame(pygame.mouse.get_pos(), surface)


def light_color(color: Any) -> Any:
    """A colour whose red, green, blue and opacity are a fifth larger, at most 255.

    Args:
        color: A named tuple `(r, g, b, a)`, such as `SpaceDebugColor` of pymunk.
    """
    return type(color)(*(min(1.2 * value, 255.0) for value in color))


def pymunk_to_shapely(body: Any, shapes: Iterable[Any]) -> Any:
    """The polygons and circles of a body of pymunk, in the simulation's coordinates, as a `MultiPolygon` of shapely.

    Raises:
        TypeError: If a shape is neither a polygon nor a circle.
    """
    from shapely.geometry import MultiPolygon, Point, Polygon

    parts = []
    for shape in shapes:
        if hasattr(shape, "get_vertices"):
            parts.append(Polygon([tuple(body.local_to_world(vertex)) for vertex in shape.get_vertices()]))
        elif hasattr(shape, "offset"):
            parts.append(Point(tuple(body.local_to_world(shape.offset))).buffer(shape.radius))
        else:
            raise TypeError(f"pymunk_to_shapely: {type(shape).__name__}; expected polygons (Poly) and circles (Circle)")
    return MultiPolygon(parts)


def perturb_camera_angle(xyaxis: Sequence[float], deg_dif: Sequence[float] = [3, 3]) -> tuple[float, ...]:
    """Turns the axes of a camera of MuJoCo, as the factor `camera.angle_delta` of OGBench does.

    Args:
        xyaxis: The x and the y axis of the camera, six elements.
        deg_dif: The angles in degrees, about the world's z axis and then about its x axis.
    """
    about_z, about_x = np.deg2rad(np.asarray(deg_dif, np.float64))
    turn_z, turn_x = np.eye(3), np.eye(3)
    turn_z[:2, :2] = [[np.cos(about_z), -np.sin(about_z)], [np.sin(about_z), np.cos(about_z)]]
    turn_x[1:, 1:] = [[np.cos(about_x), -np.sin(about_x)], [np.sin(about_x), np.cos(about_x)]]
    axes = np.asarray(xyaxis, np.float64).reshape(2, 3)
    return tuple(float(value) for value in (axes @ (turn_x @ turn_z).T).reshape(-1))


class DrawOptions:
    """Draws a space of pymunk on a surface of pygame: `space.debug_draw(DrawOptions(surface))`.

    An instance is a `pymunk.SpaceDebugDrawOptions`.

    Args:
        surface: The surface.
    """

    def __new__(cls, surface: Any) -> DrawOptions:
        import pymunk

        if not issubclass(cls, pymunk.SpaceDebugDrawOptions):
            cls = type(cls.__name__, (cls, pymunk.SpaceDebugDrawOptions), {})
        return object.__new__(cls)

    def __init__(self, surface: Any) -> None:
        self.surface = surface
        super().__init__()

    def draw_circle(self, pos: Any, angle: float, radius: float, outline_color: Any, fill_color: Any) -> None:
        """Draws a disc with a rim of four pixels."""
        import pygame

        centre = to_pygame(pos, self.surface)
        pygame.draw.circle(self.surface, _rgba(fill_color), centre, round(radius))
        pygame.draw.circle(self.surface, _rgba(light_color(fill_color)), centre, round(radius - 4))

    def draw_segment(self, a: Any, b: Any, color: Any) -> None:
        """Draws a thin line."""
        import pygame

        pygame.draw.aaline(self.surface, _rgba(color), to_pygame(a, self.surface), to_pygame(b, self.surface))

    def draw_fat_segment(self, a: Any, b: Any, radius: float, outline_color: Any, fill_color: Any) -> None:
        """Draws a thick line with round ends."""
        import pygame

        ends = [np.asarray(to_pygame(point, self.surface), np.float64) for point in (a, b)]
        along = ends[1] - ends[0]
        length = float(np.linalg.norm(along))
        colour = _rgba(fill_color)
        if radius > 1 and length > 0:
            side = np.array([-along[1], along[0]]) / length * radius
            corners = [ends[0] + side, ends[1] + side, ends[1] - side, ends[0] - side]
            pygame.draw.polygon(self.surface, colour, [tuple(corner) for corner in corners])
            for end in ends:
                pygame.draw.circle(self.surface, colour, (round(end[0]), round(end[1])), round(radius))
        else:
            pygame.draw.line(self.surface, colour, tuple(ends[0]), tuple(ends[1]), max(1, round(2 * radius)))

    def draw_polygon(self, verts: Any, radius: float, outline_color: Any, fill_color: Any) -> None:
        """Draws a polygon with a rim of four pixels."""
        import pygame

        pygame.draw.polygon(self.surface, _rgba(light_color(fill_color)), [to_pygame(v, self.surface) for v in verts])
        for index, vertex in enumerate(verts):
            self.draw_fat_segment(vertex, verts[(index + 1) % len(verts)], 2, fill_color, fill_color)

    def draw_dot(self, size: float, pos: Any, color: Any) -> None:
        """Draws a disc."""
        import pygame

        pygame.draw.circle(self.surface, _rgba(color), to_pygame(pos, self.surface), round(size))


def _rgba(color: Any) -> tuple[int, ...]:
    return tuple(int(value) for value in color)
