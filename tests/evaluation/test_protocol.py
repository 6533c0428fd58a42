"""All protocols on one result: a perfect one, its invariances, and truth that lacks something."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.scored_room import room_and_truth
from vggtjax import cameras as geometry
from vggtjax.evaluation.metrics.video_depth import Align
from vggtjax.evaluation.protocol import depth_at_source, score
from vggtjax.evaluation.truth_at_pixels import TruthAtPixels

POINTS = [
    f"{name}_{kind}"
    for name in ("accuracy", "completeness", "distance_paired", "distance_chamfer")
    for kind in ("mean", "median")
]


def noisy(room, seed=0):
    """The same result with wrong depth, wrong masks and cameras that are a little off."""
    random = np.random.default_rng(seed)
    poses = room.world_from_camera.astype(np.float64)
    poses[:, :3, :3] = Rotation.from_rotvec(0.03 * random.normal(size=(len(poses), 3))).as_matrix() @ poses[:, :3, :3]
    poses[:, :3, 3] += 0.05 * random.normal(size=(len(poses), 3))
    return dataclasses.replace(
        room,
        depth=room.depth * random.uniform(0.8, 1.2, room.depth.shape).astype(np.float32),
        dynamic_mask=np.roll(room.dynamic_mask, 3, axis=2),
        camera_from_world=geometry.world_from_camera(poses[:, :3])[:, :3],
    )


def transformed(room, scale, turn, shift):
    """The same result in another world: all poses moved by a Sim(3), depth scaled with it."""
    rotation = Rotation.from_rotvec(turn).as_matrix()
    poses = room.world_from_camera.astype(np.float64)
    poses[:, :3, 3] = scale * poses[:, :3, 3] @ rotation.T + shift
    poses[:, :3, :3] = rotation @ poses[:, :3, :3]
    inverse = geometry.world_from_camera(poses[:, :3])[:, :3]
    return dataclasses.replace(room, depth=room.depth * np.float32(scale), camera_from_world=inverse)


def test_a_perfect_result_scores_zero_or_one():
    room, sequence = room_and_truth()
    scores = score(room, TruthAtPixels(sequence, room))
    metrics = scores.metrics
    for name in POINTS:
        assert metrics[name] < 1e-4, name
    assert max(metrics[name] for name in ("ate", "rte")) < 1e-5
    assert metrics["rre"] < 1e-2  # degrees, of rotations in float32
    assert metrics["j_mean"] == metrics["f_mean"] == metrics["j_recall"] == 1
    assert metrics["abs_rel"] < 0.02  # bilinear across the edge of the box
    assert metrics["delta1"] > 0.97
    (note,) = scores.notes  # nothing is uncertain
    assert note.startswith("uncertainty: all errors are 0")


def test_a_worse_result_scores_worse():
    room, sequence = room_and_truth()
    metrics = score(noisy(room), TruthAtPixels(sequence, room)).metrics
    assert metrics["distance_paired_mean"] > metrics["accuracy_mean"] > 0.01
    assert metrics["ate"] > 0.01
    assert metrics["rre"] > 1
    assert metrics["j_mean"] < 0.8
    assert metrics["abs_rel"] > 0.05
    assert metrics["ause"] > 0


@settings(max_examples=8)
@given(
    scale=st.floats(0.2, 5),
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
    shift=st.tuples(*[st.floats(-3, 3)] * 3),
)
def test_any_similarity_of_the_whole_prediction_changes_no_number(scale, turn, shift):
    room, sequence = room_and_truth()
    worse = noisy(room)
    truth = TruthAtPixels(sequence, room)
    before = score(worse, truth).metrics
    after = score(transformed(worse, scale, turn, np.array(shift)), truth).metrics
    for name in (*POINTS, "ate", "rte", "rre", "abs_rel", "delta1", "j_mean", "f_mean", "ause"):
        assert after[name] == pytest.approx(before[name], rel=2e-3, abs=2e-4), name


def test_what_the_truth_lacks_is_said():
    room, sequence = room_and_truth(mask=None, world_from_camera=None)
    scores = score(noisy(room), TruthAtPixels(sequence, room))
    assert {"abs_rel", "ause"} <= set(scores.metrics)
    assert not {"ate", "accuracy_mean", "j_mean"} & set(scores.metrics)
    assert scores.notes == (
        "trajectory: the sequence has no camera poses",
        "point clouds: the sequence has no camera poses",
        "masks: the sequence has no masks",
    )
    assert scores.problems == ()


def test_cameras_that_stand_still_are_a_problem_and_not_a_number():
    room, sequence = room_and_truth()
    still = np.tile(room.camera_from_world[:1], (len(room.depth), 1, 1))
    scores = score(dataclasses.replace(room, camera_from_world=still), TruthAtPixels(sequence, room))
    assert "ate" not in scores.metrics
    assert "accuracy_mean" not in scores.metrics
    assert {problem.split(":")[0] for problem in scores.problems} == {"trajectory", "point clouds"}
    assert "j_mean" in scores.metrics


def test_true_cameras_that_stand_still_are_a_note():
    room, sequence = room_and_truth()
    poses = np.tile(np.eye(4), (len(room.depth), 1, 1))
    _, sequence = room_and_truth(world_from_camera=poses)
    scores = score(room, TruthAtPixels(sequence, room))
    assert scores.problems == ()
    assert {note.split(":")[0] for note in scores.notes} == {"trajectory", "point clouds", "uncertainty"}


def test_predictions_that_are_no_numbers_are_problems():
    room, sequence = room_and_truth()
    depth = room.depth.copy()
    depth[:, ::7] = np.nan
    scores = score(dataclasses.replace(room, depth=depth), TruthAtPixels(sequence, room))
    assert {problem.split(":")[0] for problem in scores.problems} == {"point clouds", "video depth", "uncertainty"}


def test_what_was_never_predicted_is_not_scored():
    room, sequence = room_and_truth()
    room = dataclasses.replace(noisy(room), settings={"missing": ["dynamic_mask", "depth_confidence"]})
    scores = score(room, TruthAtPixels(sequence, room))
    assert scores.notes == ("masks: the result has no masks", "uncertainty: the result has no confidence")
    assert not {"j_mean", "ause"} & set(scores.metrics)


def test_depth_that_is_too_far_counts_nowhere():
    room, sequence = room_and_truth()
    near = sequence.depth
    assert near is not None

    def with_sky(frame):
        depth = near(frame).copy()
        depth[:8] = 1e4
        return depth

    worse = noisy(room)
    _, sky = room_and_truth(depth=with_sky)
    _, holes = room_and_truth(depth=lambda frame: np.where(with_sky(frame) > 100, 0, with_sky(frame)))
    made = score(worse, TruthAtPixels(sky, room, max_depth=70.0)).metrics
    expected = score(worse, TruthAtPixels(holes, room)).metrics
    assert made == pytest.approx(expected)


def test_padding_is_no_part_of_the_picture():
    room, sequence = room_and_truth()
    worse = noisy(room)
    plain = score(worse, TruthAtPixels(sequence, room)).metrics

    def padded(array, value):
        return np.pad(array, ((0, 0), (14, 0), (0, 0)) + ((0, 0),) * (array.ndim - 3), constant_values=value)

    offset = room.source_offset - [0, 14 * 2]
    box = np.add(room.valid_box, [0, 14, 0, 14])
    assert worse.saliency is not None
    large = dataclasses.replace(
        worse,
        depth=padded(worse.depth, 1),
        depth_confidence=padded(worse.depth_confidence, 9),
        dynamic_mask=padded(worse.dynamic_mask, True),
        saliency=np.pad(worse.saliency, ((0, 0), (1, 0), (0, 0)), constant_values=1),
        images=padded(worse.images, 255),
        source_offset=offset,
        valid_box=box,
    )
    made = score(large, TruthAtPixels(sequence, large)).metrics
    for name in ("j_mean", "f_mean", "saliency_auc", "ause", "abs_rel"):
        assert made[name] == pytest.approx(plain[name]), name


def test_pictures_of_two_sizes_are_a_problem():
    room, _ = room_and_truth()
    _, sequence = room_and_truth(mask=lambda frame: np.zeros((56 + frame, 84), bool))
    scores = score(room, TruthAtPixels(sequence, room))
    assert [problem.split(":")[0] for problem in scores.problems] == ["masks"]
    assert "have 4 sizes" in scores.problems[0]


def test_error_maps_are_those_of_the_alignment_that_is_scored():
    room, sequence = room_and_truth()
    half = dataclasses.replace(room, depth=room.depth / 2)
    cases: dict[Align, float] = {"metric": 0.5, "scale": 0.0}
    for align, error in cases.items():
        scores = score(half, TruthAtPixels(sequence, room), depth_align=align)
        assert np.nanmedian(scores.curves["error_maps"]) == pytest.approx(error, abs=2e-3)
        assert scores.metrics["abs_rel"] == pytest.approx(error, abs=0.02)


def test_depth_at_the_source_is_a_bilinear_resize_where_nothing_is_cut():
    from PIL import Image

    room, _ = room_and_truth()
    made, seen = depth_at_source(room)
    assert seen.all()
    for depth, large in zip(room.depth, made, strict=True):
        expected = np.asarray(Image.fromarray(depth).resize((84, 56), Image.Resampling.BILINEAR))
        np.testing.assert_allclose(large, expected, rtol=1e-5)


def test_what_was_cut_off_is_not_compared():
    room, _ = room_and_truth()
    size = np.tile([76, 84], (4, 1))  # ten rows above and ten below were cut
    cut = dataclasses.replace(room, source_size=size, source_offset=np.tile([0.0, 10.0], (4, 1)))
    made, seen = depth_at_source(cut)
    assert made.shape == seen.shape == (4, 76, 84)
    assert not seen[:, :9].any()
    assert not seen[:, -9:].any()
    assert seen[:, 10:66].all()
