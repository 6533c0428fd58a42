"""Refinement of cameras: exact and partly wrong matches of a known room, its painted pictures, and what is refused."""

import dataclasses

import numpy as np
import pytest

pytest.importorskip("pycolmap", reason="needs the extra colmap")

from tests.shared.corner import FOCAL, HEIGHT, SCALE, WIDTH, corner_result, exact_tracks, make_corner, paint
from vggtjax.cameras import world_from_camera
from vggtjax.options import Options
from vggtjax.pipeline.agreement import agree_with_pixels
from vggtjax.pipeline.refinement.matches import frame_pairs
from vggtjax.pipeline.refinement.refine import adjust_to_tracks, refine_with_points, warn_of_kept
from vggtjax.pipeline.refinement.tracks import join_matches
from vggtjax.research.evaluation.metrics.trajectory import rotation_error, trajectory_errors


def camera_errors(result, corner):
    """Return ATE after a similarity, rotation error in degrees, and the focal length's error as a share."""
    poses = result.camera_from_world.astype(np.float64)
    ate = trajectory_errors(world_from_camera(poses), world_from_camera(corner.camera_from_world)).ate
    focal = np.abs(result.intrinsics[:, 0, 0] * SCALE / FOCAL - 1).max()
    return ate, rotation_error(poses, corner.camera_from_world), focal


@pytest.mark.parametrize("wrong", [0.0, 0.2])
def test_cameras_converge_to_the_truth(wrong):
    corner = make_corner()
    result = corner_result(corner)
    refined, report, _ = adjust_to_tracks(result, exact_tracks(corner, wrong))
    assert (np.array(camera_errors(result, corner)) > [0.05, 2, 0.05]).all()
    assert (np.array(camera_errors(refined, corner)) < [1e-4, 0.005, 2e-4]).all()
    assert report.refined
    assert report.error_after == pytest.approx(0, abs=0.01)
    np.testing.assert_array_equal(refined.camera_from_world[0], result.camera_from_world[0])
    np.testing.assert_array_equal(refined.depth, result.depth)
    true = corner_result(corner, degrees=0, share=0)
    steps = [np.linalg.norm(np.diff(each.camera_centres, axis=0), axis=1) for each in (refined, true)]
    np.testing.assert_allclose(*steps, rtol=0.01)  # the scale of the depth


def test_pictures_refine_cameras_and_what_moves_has_no_vote():
    corner = make_corner()
    pictures = paint(corner)
    poster = np.random.default_rng(5).integers(0, 255, (12, 16, 1), np.uint8).repeat(6, 0).repeat(6, 1)  # 72 x 96
    for frame, picture in enumerate(pictures):
        left = 4 + 17 * frame
        picture[50:122, left : left + 96] = poster
    result = corner_result(corner)
    mask = np.zeros_like(result.dynamic_mask)
    for frame in range(len(mask)):
        left = (4 + 17 * frame) // SCALE
        mask[frame, 50 // SCALE : 41, left : left + 33] = True
    steps = []
    known = dataclasses.replace(result, dynamic_mask=mask)
    masked, report, _ = refine_with_points(known, pictures, progress=lambda done, total: steps.append((done, total)))
    unmasked = refine_with_points(result, pictures).result
    before, with_mask, without = (camera_errors(each, corner) for each in (result, masked, unmasked))
    assert report.refined
    assert with_mask[0] < 0.2 * before[0]
    assert with_mask[1] < 0.2 * before[1]
    assert with_mask[0] < 0.5 * without[0]
    assert masked.settings["refined_cameras"]["sentence"] == report.sentence == masked.known_facts["cameras"]
    assert [done for done, _ in steps] == sorted(done for done, _ in steps)
    assert steps[-1][0] == steps[-1][1]


def test_clips_that_cannot_be_refined_keep_their_cameras(caplog):
    corner = make_corner()
    result = corner_result(corner)
    grey = np.full((6, HEIGHT, WIDTH, 3), 128, np.uint8)
    kept, report, _ = refine_with_points(result, grey)
    warn_of_kept(report)
    assert report.sentence == "the network's cameras were kept: 0 static points were matched; at least 24 are needed"
    assert report.sentence in caplog.text
    np.testing.assert_array_equal(kept.camera_from_world, result.camera_from_world)
    still = dataclasses.replace(result, dynamic_mask=np.ones_like(result.dynamic_mask))
    assert refine_with_points(still, paint(corner)).report.points == 0
    tracks = exact_tracks(corner)
    alone = tracks._replace(frames=np.where(tracks.frames == 4, 3, tracks.frames))
    assert "frame 4 sees 0 matched points" in adjust_to_tracks(result, alone)[1].reason
    depth = result.depth * np.exp(np.random.default_rng(0).normal(0, 3, result.depth.shape)).astype(np.float32)
    assert not adjust_to_tracks(dataclasses.replace(result, depth=depth), tracks)[1].refined


def test_two_frames_and_one():
    corner = make_corner(2, 0.3)
    K = corner.intrinsics.copy()
    K[:, :2] /= SCALE
    result = dataclasses.replace(corner_result(corner, degrees=3), intrinsics=K.astype(np.float32))
    refined, report, _ = adjust_to_tracks(result, exact_tracks(corner), fixed_intrinsics=True)
    np.testing.assert_allclose(refined.intrinsics, result.intrinsics, rtol=1e-6)
    refined, report, _ = adjust_to_tracks(result, exact_tracks(corner))
    assert report.refined
    assert rotation_error(refined.camera_from_world, corner.camera_from_world) < 0.01
    np.testing.assert_allclose(refined.intrinsics, result.intrinsics, rtol=1e-6)  # two frames do not hold it
    single = corner_result(make_corner(1))
    assert not refine_with_points(single, paint(make_corner(1))).report.refined


def test_pairs_and_tracks_by_hand():
    assert frame_pairs(3) == [(0, 1), (1, 2), (0, 2)]
    assert len(frame_pairs(30)) == 30 * 29 // 2
    far = frame_pairs(100)
    assert {second - first for first, second in far} == {*range(1, 9), 12, 16, 24, 32, 48, 64, 96}
    assert {frame for pair in far for frame in pair} == set(range(100))
    # Feature 0 of three frames is one point; frame 2 has two places for the point of feature 1, and loses it.
    places = [np.arange(6.0).reshape(3, 2) + 10 * frame for frame in range(3)]
    same = np.array([[0, 0], [1, 1]])
    matches = {(0, 1): same, (1, 2): same, (0, 2): np.array([[1, 2]])}
    tracks = join_matches(places, matches, 2)
    assert tracks.points.tolist() == [0, 1, 0, 1, 0]
    assert tracks.frames.tolist() == [0, 0, 1, 1, 2]
    assert tracks.positions[-1].tolist() == [20, 21]
    assert join_matches(places, matches, 3).number == 1


def test_refined_points_are_fitted_by_consistent_depth_too():
    corner = make_corner(4, 0.7)
    pictures, predicted = paint(corner), corner_result(corner, degrees=2)
    options = Options(refine_cameras=True, consistent_depth=True)
    made = agree_with_pixels(predicted, lambda: iter(pictures), options)
    assert made.settings["consistency"]["points"] > 100
    assert list(made.known_facts) == ["cameras", "depth"]
    before, after = (rotation_error(each.camera_from_world, corner.camera_from_world) for each in (predicted, made))
    assert after < 0.1 * before
