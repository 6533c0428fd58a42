from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.shared.room import make_room
from vggtjax.results.shown import shown_points
from vggtjax.results.thinning import Candidates, EvenThinning, places_in_cube

ALL: dict[str, Any] = {"static_percentile": 0, "dynamic_percentile": 0, "edges": None}
OFF_EDGES: dict[str, Any] = {**ALL, "edges": 0.05}


@pytest.fixture(scope="module")
def room():
    return make_room(frames=4)


def test_without_limits_every_valid_pixel_is_shown_once(room):
    static, moving = shown_points(room, **ALL)
    points = room.world_points().reshape(4, -1, 3)
    mask = room.dynamic_mask.reshape(4, -1)
    np.testing.assert_array_equal(np.stack([static.frames, static.pixels]), np.nonzero(~mask))
    np.testing.assert_allclose(static.positions, points[~mask], rtol=1e-5, atol=1e-6)
    assert len(moving) == 4
    for frame, shown in enumerate(moving):
        assert set(shown.frames) == {frame}
        np.testing.assert_array_equal(shown.pixels, np.flatnonzero(mask[frame]))
        np.testing.assert_array_equal(shown.values(room.images), room.images[frame][room.dynamic_mask[frame]])


def test_pixels_beside_a_step_of_depth_are_left_out():
    depth = np.full((1, 28, 42), 5.0, np.float32)
    depth[0, 10:20, 10:20] = 3.0
    depth[0, 0, 0] = 0  # unknown: no step beside it
    room = make_room(1, depth=depth, dynamic_mask=np.zeros((1, 28, 42), bool))
    static, _ = shown_points(room, **OFF_EDGES)
    kept = np.zeros((28, 42), bool)
    kept.ravel()[static.pixels] = True
    expected = np.ones((28, 42), bool)
    expected[9:21, 10:20] = expected[10:20, 9:21] = False
    expected[11:19, 11:19] = True
    expected[0, 0] = False
    np.testing.assert_array_equal(kept, expected)


def test_budgets_are_met_evenly_and_always_alike(room):
    static, moving = shown_points(room, most_static=500, most_moving=20)
    again, _ = shown_points(room, most_static=500, most_moving=20)
    assert 400 < len(static.pixels) <= 500
    assert [len(shown.pixels) for shown in moving] == [20] * 4
    np.testing.assert_array_equal(static.pixels, again.pixels)
    assert (np.diff(static.frames * 28 * 42 + static.pixels) > 0).all()
    static, moving = shown_points(make_room(2, depth=np.zeros((2, 28, 42), np.float32)))
    assert len(static.positions) == sum(len(shown.positions) for shown in moving) == 0
    assert static.values(np.zeros((2, 28, 42, 3))).shape == (0, 3)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.integers(1, 5), st.booleans())
def test_each_voxel_keeps_its_most_confident_point(seed, budget, chunks, ties):
    random = np.random.default_rng(seed)
    positions = (random.normal(size=(200, 3)) ** 3).astype(np.float32)
    confidence = np.ones(200) if ties else random.permutation(200)
    places, pixels = places_in_cube(positions, np.zeros(3), 1.0), np.arange(200, dtype=np.int32)
    points = Candidates(positions, places, confidence.astype(np.float32), 0 * pixels, pixels)
    thinning = EvenThinning(budget)
    for part in np.array_split(np.arange(200), chunks):
        thinning.add(points.take(part))
    kept: Any = thinning.kept()
    assert 1 <= len(kept.pixels) <= budget
    assert (np.diff(kept.pixels) > 0).all()
    assert (0 if ties else np.argmax(confidence)) in kept.pixels  # of equals the first
