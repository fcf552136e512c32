"""Helpers of drawing with pymunk, pygame and shapely."""

import numpy as np
import pytest

pygame = pytest.importorskip("pygame")
pymunk = pytest.importorskip("pymunk")
pytest.importorskip("shapely")

from stable_worldmodel.envs import utils  # noqa: E402


@pytest.fixture
def space():
    space = pymunk.Space()
    body = pymunk.Body(1, 1)
    body.position, body.angle = (60, 40), np.pi / 2
    box, disc = pymunk.Poly(body, [(-20, -5), (20, -5), (20, 5), (-20, 5)]), pymunk.Circle(body, 10, (0, 30))
    box.color, disc.color = (200, 100, 50, 255), (50, 100, 200, 255)
    wall = pymunk.Segment(space.static_body, (5, 90), (115, 90), 3)
    wall.color = (10, 200, 10, 255)
    space.add(body, box, disc, wall)
    return space


def test_a_space_is_drawn(space):
    surface = pygame.Surface((120, 100))
    options = utils.DrawOptions(surface)
    assert isinstance(options, pymunk.SpaceDebugDrawOptions) and isinstance(options, utils.DrawOptions)
    options.flags = pymunk.SpaceDebugDrawOptions.DRAW_SHAPES
    space.debug_draw(options)
    # The box is upright, lighter inside than on its rim; the disc is on its left; the wall is below.
    assert surface.get_at((60, 40))[:3] == (240, 120, 60) and surface.get_at((60, 59))[:3] == (200, 100, 50)
    assert surface.get_at((78, 40))[:3] == (0, 0, 0)
    assert surface.get_at((30, 40))[:3] == (60, 120, 240) and surface.get_at((30, 49))[:3] == (50, 100, 200)
    assert surface.get_at((100, 92))[:3] == (10, 200, 10) and surface.get_at((100, 96))[:3] == (0, 0, 0)
    options.draw_segment((0, 0), (119, 0), options.shape_dynamic_color)
    options.draw_dot(3, (110, 10), options.shape_dynamic_color)
    assert surface.get_at((50, 0))[:3] != (0, 0, 0) and surface.get_at((110, 10))[:3] != (0, 0, 0)


def test_bodies_become_polygons(space):
    (body,) = space.bodies
    found = utils.pymunk_to_shapely(body, list(body.shapes))
    assert found.geom_type == "MultiPolygon" and len(found.geoms) == 2
    disc, box = sorted(found.geoms, key=lambda part: part.area)
    assert np.allclose(box.bounds, (55, 20, 65, 60)) and np.isclose(box.area, 400)
    assert np.allclose(disc.bounds, (20, 30, 40, 50), atol=0.1) and abs(disc.area - 100 * np.pi) < 3
    with pytest.raises(TypeError, match="Segment"):
        utils.pymunk_to_shapely(space.static_body, list(space.static_body.shapes))


def test_the_mouse_is_at_a_point(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame.display.init()
    pygame.display.set_mode((20, 20))
    assert len(utils.get_mouse_pos(pygame.display.get_surface())) == 2
