"""The costs of a sweep against a slow reference, pixel by pixel."""

import numpy as np
from scipy.ndimage import map_coordinates, uniform_filter

from tests.textured_room import textured_room
from vggtjax.cameras import project, unproject
from vggtjax.known.sweep import Views, sweep_costs


def test_costs_are_those_of_pixels_moved_one_by_one():
    room = textured_room(3)
    grey = room.images[..., 0] / 255
    views = Views(grey, room.depth, room.intrinsics, room.camera_from_world, ~room.dynamic_mask)
    found = sweep_costs(views, np.array([0.8, 1.0]), 2)
    assert found.shape == (3, 2, 56, 84)
    for factor in (0.8, 1.0):
        points = unproject(factor * room.depth, room.intrinsics, room.camera_from_world, pixel_offset=0.5)[0]
        x, y, away = project(points.reshape(-1, 3).astype(np.float64), room.camera_from_world[2], room.intrinsics[2])
        column, row = x - 0.5, y - 0.5
        there = map_coordinates(grey[2], [row, column], order=1, mode="nearest").reshape(56, 84)

        def mean(image):
            return uniform_filter(image, 5, mode="nearest")

        covariance = mean(grey[0] * there) - mean(grey[0]) * mean(there)
        spread = [np.maximum(mean(image**2) - mean(image) ** 2, 0) + 1e-4 for image in (grey[0], there)]
        seen = (column >= 0) & (column <= 83) & (row >= 0) & (row <= 55) & (away > 0)
        inside = np.rint(np.clip(row, 0, 55)).astype(int), np.rint(np.clip(column, 0, 83)).astype(int)
        seen &= ~room.dynamic_mask[2][inside]
        expected = 1 - np.where(seen.reshape(56, 84), covariance / np.sqrt(spread[0] * spread[1]), -0.2)
        x, y, away = project(room.world_points()[0].reshape(-1, 3), room.camera_from_world[2], room.intrinsics[2])
        shown = ((x >= 0.5) & (x <= 83.5) & (y >= 0.5) & (y <= 55.5) & (away > 0)).reshape(56, 84)
        alone = sweep_costs(views, np.array([factor]), 1)[0, 0]  # with frame 2 alone
        np.testing.assert_allclose(alone, np.where(shown, expected, 1), atol=2e-3)
        assert 0.05 < shown.mean() < 0.95
    assert found[:, 1].mean() < 0.5 * found[:, 0].mean()  # the true depth looks alike
