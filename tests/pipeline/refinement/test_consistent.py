"""Consistent depth and the mask by pixels: painted rooms seen from known places, moving posters, and what stays."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import zoom
from skimage.measure import label

from tests.shared.corner import HEIGHT, SCALE, WIDTH, corner_result, make_corner, paint
from vggtjax.errors import ClipError
from vggtjax.options import Options
from vggtjax.pipeline import agreement
from vggtjax.pipeline.agreement import agree_with_pixels
from vggtjax.pipeline.refinement import consistent
from vggtjax.pipeline.refinement.consistent import ConsistencyReport, consistent_depth
from vggtjax.pipeline.refinement.dense import KNOWN
from vggtjax.pipeline.refinement.pixel_mask import SOURCE, mask_by_pixels
from vggtjax.progress import StageSeconds
from vggtjax.research.evaluation.metrics.depth import depth_errors
from vggtjax.research.evaluation.metrics.trajectory import rotation_error

CONSISTENT = Options(consistent_depth=True)


@pytest.fixture(scope="module")
def corner():
    return make_corner(4, 0.7)


@pytest.fixture(scope="module")
def pictures(corner):
    return paint(corner)


@pytest.fixture(scope="module")
def truth(corner):
    return corner_result(corner, degrees=0, share=0)


@pytest.fixture(scope="module")
def predicted(corner):
    """A result whose depth is wrong by a smooth field of its own in each frame, and whose cameras are turned."""
    return wavy(corner_result(corner, degrees=2, share=0))


def wavy(result):
    noise = np.random.default_rng(3).normal(0, 0.15, (len(result.depth), 3, 4))
    size = result.depth.shape[1:]
    fields = np.array([zoom(each, (size[0] / 3, size[1] / 4), order=1) for each in noise])
    return dataclasses.replace(result, depth=result.depth * np.exp(fields).astype(np.float32))


def errors(result, truth, corner):
    depth = depth_errors(result.depth, truth.depth, truth.depth > 0)
    return depth.abs_rel, rotation_error(result.camera_from_world, corner.camera_from_world)


def test_depth_and_cameras_come_to_the_truth(corner, pictures, truth, predicted):
    steps = []
    made, report = consistent_depth(predicted, iter(pictures), progress=lambda done, total: steps.append((done, total)))
    before, after = (np.array(errors(each, truth, corner)) for each in (predicted, made))
    assert report.changed
    assert (after < [0.4 * before[0], 0.1 * before[1]]).all()
    assert report.layers_before is not None
    assert report.layers_after < 0.3 * report.layers_before
    assert report.joined > 0.5
    assert made.settings["consistency"]["sentence"] == report.sentence == made.known_facts["depth"]
    assert [done for done, _ in steps] == sorted(done for done, _ in steps)
    assert steps[-1][0] == steps[-1][1]
    np.testing.assert_allclose(made.camera_from_world[0], predicted.camera_from_world[0], atol=1e-6)
    np.testing.assert_array_equal(made.dynamic_mask, predicted.dynamic_mask)


def test_cameras_that_are_far_off_are_found(corner, pictures, truth):
    turned = corner_result(corner, degrees=90, share=0)
    made, _ = consistent_depth(turned, iter(pictures))
    assert errors(made, truth, corner)[1] < 0.2


def test_frames_that_saw_nothing_in_common_agree_if_they_do_now():
    nothing, some = np.zeros(0, np.float32), np.full(3, 0.1, np.float32)
    assert consistent._agree(nothing, some, 1.0)
    assert not consistent._agree(some, nothing, 1.0)
    assert not consistent._agree(some, 2 * some, 1.0)
    report = ConsistencyReport(True, layers_before=None, layers_after=0.01)
    assert "frames differ by 1.0% (median), saw nothing in common before" in report.sentence


def test_a_narrow_clip_has_no_coarse_matches_but_fine_ones(corner, pictures):
    predicted = corner_result(corner, degrees=2, share=0)
    rows, frames = slice(18, 30), len(pictures)
    names = ("images", "depth", "depth_confidence", "dynamic_mask")
    fields: dict[str, Any] = {name: getattr(predicted, name)[:, rows] for name in names}
    fields |= {
        "intrinsics": predicted.intrinsics - np.array([[0, 0, 0], [0, 0, 18], [0, 0, 0]], np.float32),
        "source_size": np.tile(np.array([12 * SCALE, WIDTH], predicted.source_size.dtype), (frames, 1)),
        "valid_box": np.tile(np.array([0, 0, WIDTH // SCALE, 12], predicted.valid_box.dtype), (frames, 1)),
    }
    strip = dataclasses.replace(predicted, **fields)
    made, report = consistent_depth(strip, iter(pictures[:, 18 * SCALE : 30 * SCALE]), join=False)
    assert report.changed
    turned = [rotation_error(each.camera_from_world, corner.camera_from_world) for each in (predicted, made)]
    assert turned[1] < 0.3 * turned[0]


def test_a_camera_that_stands_gets_one_place_and_keeps_its_depth(predicted, pictures, truth):
    still, depth = (np.repeat(each[:1], len(pictures), axis=0) for each in (pictures, truth.depth))
    predicted = dataclasses.replace(predicted, depth=depth)
    made, report = consistent_depth(predicted, iter(still), join=False)
    assert "not changed; only the cameras fit pixels in" in report.sentence
    assert report.layers_before is not None
    assert report.layers_after < report.layers_before
    np.testing.assert_array_equal(made.depth, predicted.depth)
    first = np.repeat(made.camera_from_world[:1], len(still), axis=0)
    assert rotation_error(made.camera_from_world, first) < 0.1
    np.testing.assert_allclose(made.camera_from_world, first, atol=0.01 * np.median(predicted.depth))
    np.testing.assert_allclose(made.intrinsics[:, 0, 0], np.median(predicted.intrinsics[:, 0, 0]), rtol=1e-5)


def test_its_own_small_pictures_are_enough_to_get_better(corner, pictures, truth, predicted):
    own = dataclasses.replace(predicted, images=pictures[:, 1::SCALE, 1::SCALE])
    made, report = consistent_depth(own, join=False)
    assert report.changed
    assert report.joined == 0
    before, after = (np.array(errors(each, truth, corner)) for each in (predicted, made))
    assert (after < 0.8 * before).all()


def test_cameras_change_alone_where_frames_agree_less_after_the_fields(corner, pictures, truth, predicted, monkeypatch):
    monkeypatch.setattr(consistent, "_MOST_WORSE", 0.0)
    only_turned = dataclasses.replace(predicted, depth=truth.depth)
    made, report = consistent_depth(only_turned, iter(pictures), join=False)
    assert report.changed
    assert report.change == 0
    assert "not changed; only the cameras fit pixels in" in report.sentence
    np.testing.assert_array_equal(made.depth, only_turned.depth)
    assert errors(made, truth, corner)[1] < 0.2 * errors(only_turned, truth, corner)[1]


def test_known_cameras_stay(corner, pictures, truth, predicted):
    known = dataclasses.replace(predicted, camera_from_world=truth.camera_from_world, intrinsics=truth.intrinsics)
    made, _ = consistent_depth(known, iter(pictures), priors=KNOWN)
    np.testing.assert_array_equal(made.camera_from_world, known.camera_from_world)
    np.testing.assert_array_equal(made.intrinsics, known.intrinsics)
    assert errors(made, truth, corner)[0] < 0.3 * errors(known, truth, corner)[0]


def test_what_moves_has_no_vote(corner, pictures, truth, predicted):
    moved, mask = pictures.copy(), np.zeros_like(predicted.dynamic_mask)
    poster = np.random.default_rng(5).integers(0, 255, (12, 16, 1), np.uint8).repeat(6, 0).repeat(6, 1).repeat(3, 2)
    for frame in range(len(moved)):
        left = 4 + 17 * frame
        moved[frame, 50:122, left : left + 96] = poster
        mask[frame, 50 // SCALE : 41, left // SCALE : left // SCALE + 33] = True
    masked = dataclasses.replace(predicted, dynamic_mask=mask)
    made, _ = consistent_depth(masked, iter(moved))
    static = ~mask & (truth.depth > 0)
    before, after = (depth_errors(each.depth, truth.depth, static).abs_rel for each in (masked, made))
    assert after < 0.5 * before
    assert errors(made, truth, corner)[1] < 0.2 * errors(masked, truth, corner)[1]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda r, p: (r, np.full_like(p, 128)), "0.0% of the picture matches other frames"),
        (lambda r, p: (dataclasses.replace(r, dynamic_mask=r.depth > -1), p), "0.0% of the picture shows"),
        (lambda r, p: (first_frames(r, 2), p[:2]), "the clip has 2 frames; 3 to 512 are adjusted together"),
        (lambda r, p: (first_frames(r, 1), p[:1]), "the clip has 1 frame;"),
    ],
    ids=["no texture", "all moves", "two frames", "one frame"],
)
def test_depth_stays_where_pixels_say_too_little(predicted, pictures, caplog, change, words):
    result, shown = change(predicted, pictures)
    made, report = consistent_depth(result, iter(shown))
    assert not report.changed
    assert words in report.sentence
    assert (report.sentence in caplog.text) == (len(shown) > 2)  # a photograph needs no warning
    np.testing.assert_array_equal(made.depth, result.depth)
    np.testing.assert_array_equal(made.camera_from_world, result.camera_from_world)
    np.testing.assert_array_equal(made.intrinsics, result.intrinsics)


def test_a_lens_that_zooms_is_noticed_unless_it_is_known(corner, monkeypatch):
    """The corner's three planes and short path hide a zoom better than most clips do: hence the lower threshold."""
    monkeypatch.setattr(consistent, "_MOST_ZOOM", 2e-5)
    zoomed = corner.intrinsics.copy()
    zoomed[:, [0, 1], [0, 1]] *= np.geomspace(1, 1.2, len(zoomed))[:, None]
    zooms = corner._replace(intrinsics=zoomed)
    pictures, result = paint(zooms), wavy(corner_result(zooms, degrees=0, share=0))
    one = dataclasses.replace(result, intrinsics=np.repeat(result.intrinsics[:1], len(zoomed), axis=0))
    fields = [consistent_depth(one, iter(pictures)), consistent_depth(result, iter(pictures), priors=KNOWN)]
    assert [report.change > 0 for _, report in fields] == [False, True]
    monkeypatch.setattr(consistent, "_MOST_ZOOM", 1.0)
    assert consistent_depth(one, iter(pictures))[1].change > 0  # so it was the guard


def test_pictures_of_another_clip_are_refused(predicted, pictures):
    with pytest.raises(ClipError, match=f"100 x {HEIGHT} pixels; the result was made from {WIDTH} x {HEIGHT}"):
        consistent_depth(predicted, iter(pictures[:, :, :100]))
    with pytest.raises(ClipError, match="gives 3 pictures of the 4 frames"):
        consistent_depth(predicted, iter(pictures[:3]))


def first_frames(result, count):
    fields = {field.name: getattr(result, field.name) for field in dataclasses.fields(result)}
    of_frames = {name: value for name, value in fields.items() if isinstance(value, np.ndarray | tuple)}
    return dataclasses.replace(result, **{name: value[:count] for name, value in of_frames.items()})


@pytest.fixture(scope="module")
def room():
    """Return pictures, and the true cameras and depth, with a Gram saliency and matches that say nothing."""
    corner = make_corner(5, 0.7)
    pictures, result = paint(corner), corner_result(corner, degrees=0, share=0)
    images = pictures[:, 1::SCALE, 1::SCALE]
    saliency = np.full((len(pictures), 6, 8), 0.3, np.float32)
    settings = result.settings | {"masks": "mined"}
    fields = {"images": images, "saliency": saliency, "motion": np.ones_like(saliency), "settings": settings}
    return pictures, dataclasses.replace(result, method="4dvggt-d", **fields)


@pytest.mark.parametrize("has_matches", [True, False])
def test_what_moves_is_found(room, has_matches):
    pictures, result = room
    moved, mask = pictures.copy(), np.zeros(pictures.shape[:3], bool)
    poster = np.random.default_rng(5).integers(0, 255, (8, 8, 1), np.uint8).repeat(6, 0).repeat(6, 1).repeat(3, 2)
    for frame in range(len(moved)):
        place = (frame, slice(48, 96), slice(24 + 11 * frame, 72 + 11 * frame))
        moved[place], mask[place] = poster, True
    mask = mask[:, 1::SCALE, 1::SCALE]
    motion = 1 + mask.reshape(len(mask), 6, 8, 8, 8).mean(axis=(2, 4), dtype=np.float32)  # too little to tell alone
    motion = motion if has_matches else None
    predicted = dataclasses.replace(result, images=moved[:, 1::SCALE, 1::SCALE], motion=motion)
    assert mask_by_pixels(predicted, iter(pictures)).dynamic_mask.mean() < 0.03
    made = mask_by_pixels(predicted, iter(moved))
    assert (made.dynamic_mask & mask).sum() > 0.6 * (made.dynamic_mask | mask).sum()
    for side in (made.dynamic_mask, ~made.dynamic_mask):  # no region and no hole is smaller than a quarter of a patch
        assert min(np.bincount(np.asarray(label(frame)).ravel())[1:].min() for frame in side) > 64 / 4
    assert made.motion.shape == result.saliency.shape
    assert np.median(made.motion) == pytest.approx(1, rel=1e-5)
    assert made.settings["masks"] == SOURCE
    np.testing.assert_array_equal(made.depth, result.depth)


@pytest.mark.parametrize("has_matches", [True, False])
def test_nothing_is_found_where_nothing_moves(room, has_matches):
    pictures, result = room
    result = result if has_matches else dataclasses.replace(result, motion=None)
    assert mask_by_pixels(result, iter(pictures)).dynamic_mask.mean() < 0.03


@pytest.mark.parametrize("name", ["saliency", "motion"])
def test_the_network_has_a_say(room, name):
    pictures, result = room
    more = getattr(result, name).copy()
    more[:, 1, 1] *= 3
    there = dataclasses.replace(result, **{name: more})
    ratio = mask_by_pixels(there, iter(pictures)).motion / mask_by_pixels(result, iter(pictures)).motion
    assert (ratio[:, 1, 1] > 1.2 * ratio[:, 4, 6]).all()


def test_motion_is_averaged_over_frames(room):
    pictures, result = room
    both = (dataclasses.replace(result, settings=result.settings | {"smooth_frames": count}) for count in (1, 3))
    plain, smooth = (mask_by_pixels(each, iter(pictures)).motion for each in both)
    middle = plain[:3].mean(axis=0)
    np.testing.assert_allclose(smooth[1] / smooth[1].mean(), middle / middle.mean(), rtol=1e-4)


def stays(result, *_, **__):
    return result, ConsistencyReport(False)


def test_two_frames_equal_frames_and_masks_of_other_sources_stay(room, monkeypatch):
    monkeypatch.setattr(agreement, "consistent_depth", stays)
    pictures, result = room
    equal = dataclasses.replace(result, images=np.repeat(result.images[:1], len(result.images), axis=0))
    given = dataclasses.replace(result, settings=result.settings | {"masks": "given"})
    plain = dataclasses.replace(result, method="vggt", motion=None)
    refined = dataclasses.replace(result, settings=result.settings | {"refine_mask": True})
    unseen = dataclasses.replace(result, saliency=None, motion=None)
    for each in (first_frames(result, 2), equal, unseen, given, plain, refined):
        assert mask_by_pixels(each, iter(pictures)) is each
        stages = StageSeconds()
        made = agree_with_pixels(each, lambda: pictures, CONSISTENT, on_stage=stages.stage)
        assert "mask by pixels" not in stages.seconds
        np.testing.assert_array_equal(made.dynamic_mask, each.dynamic_mask)


def test_pictures_without_matches_and_depth_that_is_not_finite_leave_the_mask(room):
    pictures, result = room
    for value, place in ((np.nan, np.s_[2, 9]), (np.inf, np.s_[:, :24]), (0, np.s_[:])):
        depth = result.depth.copy()
        depth[place] = value
        broken = dataclasses.replace(result, depth=depth)
        assert mask_by_pixels(broken, iter(pictures)).dynamic_mask.mean() < 0.03
    assert mask_by_pixels(result, iter(np.full_like(pictures, 90))) is result


@pytest.mark.parametrize("changed", [True, False])
def test_masks_by_cues_are_mined_by_pixels_also_where_depth_stays(room, monkeypatch, changed):
    pictures, result = room
    result = dataclasses.replace(result, motion=None, dynamic_mask=np.ones_like(result.dynamic_mask))
    if not changed:
        monkeypatch.setattr(agreement, "consistent_depth", stays)
    stages = StageSeconds()
    made = agree_with_pixels(result, lambda: pictures, CONSISTENT, on_stage=stages.stage)
    assert "mask by pixels" in stages.seconds
    assert made.settings["masks"] == SOURCE
    assert made.motion is not None
    assert made.dynamic_mask.mean() < 0.05


def test_padding_says_nothing_of_the_threshold(room):
    """Half of the picture is padding: what is dynamic stays about the same in the other half."""
    pictures, result = room
    H, W = result.depth.shape[1:]
    box = np.tile(np.array([0, 0, W // 2, H]), (len(result.depth), 1))
    padded = dataclasses.replace(result, motion=None, valid_box=box)
    made = mask_by_pixels(padded, iter(pictures))
    assert made.dynamic_mask.mean() < 0.03
    assert not made.dynamic_mask[:, :, W // 2 :].any()
    assert np.median(made.motion[:, :, : made.motion.shape[2] // 2]) == pytest.approx(1, rel=1e-5)
