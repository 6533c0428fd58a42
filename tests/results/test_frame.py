"""Results at the source's size, with crop and padding undone, and the points of them that are shown."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.shared.room import make_room
from vggtjax import Reconstruction, load_clip
from vggtjax.clips.clip import Clip
from vggtjax.results.frame import SAME_SURFACE, enlarged_depth, frame_of
from vggtjax.results.shown import shown_points
from vggtjax.results.thinning import Candidates, EvenThinning, places_in_cube


def result_of(clip: Clip) -> Reconstruction:
    """A tilted plane of depth and a moving box, seen by a camera that is turned and off the origin."""
    S, H, W = clip.images.shape[:3]
    depth = (2 + np.linspace(0, 1, W)[None, None] + 0.5 * np.linspace(0, 1, H)[None, :, None]) * np.ones((S, 1, 1))
    mask = np.zeros((S, H, W), bool)
    mask[:, H // 4 : H // 2, W // 4 : W // 2] = True
    turn = np.array([[0.8, 0, 0.6, 0.1], [0, 1, 0, -0.2], [-0.6, 0, 0.8, 0.3]])
    of_source = ("source_size", "source_scale", "source_offset", "valid_box")
    return make_room(
        S,
        depth=depth.astype(np.float32),
        depth_confidence=np.ones_like(depth, np.float32),
        saliency=None,
        dynamic_mask=mask,
        camera_from_world=np.stack([turn] * S).astype(np.float32),
        intrinsics=np.stack([[[60.0, 0, W / 2], [0, 55.0, H / 2], [0, 0, 1]]] * S).astype(np.float32),
        images=(255 * clip.images).astype(np.uint8),
        **{name: getattr(clip, name) for name in of_source},
    )


CASES = [((160, 90), "crop"), ((90, 160), "pad"), ((30, 40), "crop")]


@pytest.mark.parametrize(("size", "mode"), CASES)
def test_depth_and_masks_lie_where_they_belong(size, mode):
    clip = load_clip(np.zeros((2, *size, 3), np.uint8), size=56, mode=mode)
    result = result_of(clip)
    frame = frame_of(result, 0, "original")
    assert frame.depth.shape == frame.dynamic_mask.shape == frame.seen.shape == size
    points = np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 5], size=(50, 3))
    local = points @ result.camera_from_world[0, :, :3].T + result.camera_from_world[0, :, 3]
    small, large = ((local @ K.T)[:, :2] / local[:, 2:] for K in (result.intrinsics[0].astype(float), frame.intrinsics))
    assert np.abs(clip.to_source(0, small) - large).max() < 1e-4
    y, x = np.nonzero(frame.seen)
    places = clip.from_source(0, np.stack([x + 0.5, y + 0.5], axis=-1))
    left, top, right, bottom = clip.valid_box[0]
    assert (places >= [left, top]).all()
    assert (places <= [right, bottom]).all()
    H, W = result.depth.shape[1:]
    column, row = np.clip(np.floor(places).astype(int), 0, [W - 1, H - 1]).T
    assert np.array_equal(frame.dynamic_mask[y, x], result.dynamic_mask[0, row, column])
    plane = 2 + (places[:, 0] - 0.5) / (W - 1) + 0.5 * (places[:, 1] - 0.5) / (H - 1)
    inside = ((places > [left + 0.5, top + 0.5]) & (places < [right - 0.5, bottom - 0.5])).all(axis=1)
    assert np.abs(frame.depth[y, x] - plane)[inside].max() < 2e-3
    assert not frame.depth[~frame.seen].any()
    np.testing.assert_array_equal(frame.instances, frame.dynamic_mask.astype(np.uint8))
    if mode == "pad":
        assert frame.seen.all()


@given(st.integers(2, 9), st.integers(1, 40), st.integers(0, 10**6))
@settings(max_examples=40)
def test_no_depth_is_invented_between_surfaces(side, count, seed):
    generator = np.random.default_rng(seed)
    depth = generator.choice([1.0, 1.02, 2.0, 0.0, np.inf], size=(side, side))
    position = generator.uniform(0, side, size=count)
    made = enlarged_depth(depth, position, position)
    known = np.unique(depth)
    for value in made.ravel():
        assert any(abs(value - one) <= SAME_SURFACE * one for one in known[np.isfinite(known)]) or np.isinf(value)


def test_valid_pixels_by_hand():
    room = make_room()
    depth, confidence = room.depth.copy(), room.depth_confidence.copy()
    depth[0, 0, :4] = (np.inf, np.nan, 0, -1)
    confidence[1, 0, :2] = (np.inf, np.nan)
    box = room.valid_box.copy()
    box[2] = (3, 5, 40, 27)
    room = make_room(depth=depth, depth_confidence=confidence, valid_box=box)
    expected = np.ones_like(room.dynamic_mask)
    expected[0, 0, :4] = expected[1, 0, :2] = False
    expected[2] = False
    expected[2, 5:27, 3:40] = True
    np.testing.assert_array_equal(room.valid_pixels, expected)
    np.testing.assert_array_equal(np.stack([frame_of(room, number).valid for number in range(3)]), expected)


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
