import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.shared.scored_room import room_and_truth
from vggtjax import cameras as geometry
from vggtjax.cameras import Similarity, align
from vggtjax.research.evaluation.protocol import depth_at_source, score
from vggtjax.research.evaluation.truth_at_pixels import TruthAtPixels

CLOUDS = ("accuracy", "completeness", "distance_paired", "distance_chamfer")
POINTS = [f"{name}_{kind}" for name in CLOUDS for kind in ("mean", "median")]


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
    worse = score(noisy(room), TruthAtPixels(sequence, room)).metrics
    assert worse["distance_paired_mean"] > worse["accuracy_mean"] > 0.01
    assert min(worse["ate"], worse["rre"] / 100) > 0.01
    assert worse["j_mean"] < 0.8
    assert worse["abs_rel"] > 0.05


@settings(max_examples=5)
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
    similarity = Similarity(scale, Rotation.from_rotvec(turn).as_matrix(), np.array(shift))
    cameras = align(worse.camera_from_world.astype(np.float64), similarity)
    moved = dataclasses.replace(worse, depth=worse.depth * np.float32(scale), camera_from_world=cameras)
    after = score(moved, truth).metrics
    for name in (*POINTS, "ate", "rte", "rre", "abs_rel", "delta1", "j_mean", "f_mean", "ause"):
        assert after[name] == pytest.approx(before[name], rel=2e-3, abs=2e-4), name


def test_what_is_lacking_is_said():
    room, sequence = room_and_truth(mask=None, world_from_camera=None)
    scores = score(noisy(room), TruthAtPixels(sequence, room))
    assert {"abs_rel", "ause"} <= set(scores.metrics)
    assert not {"ate", "accuracy_mean", "j_mean"} & set(scores.metrics)
    assert named(scores.notes) == {"trajectory", "point clouds", "masks"}
    assert (scores.notes[0], scores.problems) == ("trajectory: the sequence has no camera poses", ())
    room, sequence = room_and_truth()
    never = dataclasses.replace(noisy(room), settings={"missing": ["dynamic_mask", "depth_confidence"]})
    scores = score(never, TruthAtPixels(sequence, room))
    assert scores.notes == ("masks: the result has no masks", "uncertainty: the result has no confidence")
    assert not {"j_mean", "ause"} & set(scores.metrics)


def named(sentences):
    return {sentence.split(":")[0] for sentence in sentences}


def test_what_the_truth_cannot_tell_is_a_note_and_what_the_result_cannot_a_problem():
    room, sequence = room_and_truth()
    _, standing = room_and_truth(world_from_camera=np.tile(np.eye(4), (len(room.depth), 1, 1)))
    scores = score(room, TruthAtPixels(standing, room))
    assert scores.problems == ()
    assert named(scores.notes) == {"trajectory", "point clouds", "uncertainty"}
    still = dataclasses.replace(room, camera_from_world=np.tile(room.camera_from_world[:1], (len(room.depth), 1, 1)))
    holes = room.depth.copy()
    holes[:, ::7] = np.nan
    broken = dataclasses.replace(room, depth=holes)
    _, two_sizes = room_and_truth(mask=lambda frame: np.zeros((56 + frame, 84), bool))
    for result, truth, problems in (
        (still, sequence, {"trajectory", "point clouds"}),
        (broken, sequence, {"point clouds", "video depth", "uncertainty"}),
        (room, two_sizes, {"masks"}),
    ):
        scores = score(result, TruthAtPixels(truth, room))
        assert named(scores.problems) == problems
        assert ("ate" in scores.metrics) == (result is not still)


def test_depth_that_is_too_far_counts_nowhere():
    room, _ = room_and_truth()

    def with_sky(value):
        depth = room.depth.repeat(2, axis=1).repeat(2, axis=2)
        depth[:, :8] = value
        return room_and_truth(depth=depth.__getitem__)[1]

    made = score(noisy(room), TruthAtPixels(with_sky(1e4), room, max_depth=70.0)).metrics
    assert made == pytest.approx(score(noisy(room), TruthAtPixels(with_sky(0), room)).metrics)


def test_padding_is_no_part_of_the_picture():
    room, sequence = room_and_truth()
    worse = noisy(room)
    plain = score(worse, TruthAtPixels(sequence, room)).metrics

    def padded(array, value):
        return np.pad(array, ((0, 0), (14, 0), (0, 0)) + ((0, 0),) * (array.ndim - 3), constant_values=value)

    assert worse.saliency is not None
    large = dataclasses.replace(
        worse,
        depth=padded(worse.depth, 1),
        depth_confidence=padded(worse.depth_confidence, 9),
        dynamic_mask=padded(worse.dynamic_mask, True),
        saliency=np.pad(worse.saliency, ((0, 0), (1, 0), (0, 0)), constant_values=1),
        images=padded(worse.images, 255),
        source_offset=room.source_offset - [0, 14 * 2],
        valid_box=np.add(room.valid_box, [0, 14, 0, 14]),
    )
    made = score(large, TruthAtPixels(sequence, large)).metrics
    for name in ("j_mean", "f_mean", "saliency_auc", "ause", "abs_rel"):
        assert made[name] == pytest.approx(plain[name]), name


def test_depth_at_the_source_is_a_bilinear_resize_but_for_what_was_cut_off():
    room, _ = room_and_truth()
    made, seen = depth_at_source(room)
    assert seen.all()
    expected = np.asarray(Image.fromarray(room.depth[1]).resize((84, 56), Image.Resampling.BILINEAR))
    np.testing.assert_allclose(made[1], expected, rtol=1e-5)
    size = np.tile([76, 84], (4, 1))  # ten rows above and ten below were cut
    cut = dataclasses.replace(room, source_size=size, source_offset=np.tile([0.0, 10.0], (4, 1)))
    made, seen = depth_at_source(cut)
    assert made.shape == seen.shape == (4, 76, 84)
    assert not seen[:, :9].any()
    assert not seen[:, -9:].any()
    assert seen[:, 10:66].all()


@pytest.mark.parametrize("hole", [np.s_[:, 10:30, 20:50], np.s_[:, ::2, ::2], np.s_[0], np.s_[:, :, -1]])
def test_unknown_depth_is_never_blended(hole):
    """A right prediction with pixels of depth 0 scores as right as it does without them."""
    room, sequence = room_and_truth()
    true = room.depth.repeat(2, axis=1).repeat(2, axis=2)
    holed = dataclasses.replace(room, depth=room.depth.copy())
    holed.depth[hole] = 0
    before, after = (score(result, TruthAtPixels(sequence, room)).metrics for result in (room, holed))
    assert after["abs_rel"] < 0.02
    assert after["depth_pixels"] < before["depth_pixels"]
    assert after["delta1"] > 0.97
    assert max(after["accuracy_mean"], after["distance_paired_mean"]) < 1e-4
    predicted, _ = depth_at_source(holed)
    off = np.abs(predicted / true - 1)[predicted != 0]
    assert np.median(off) < 0.01
    assert predicted[predicted != 0].min() >= room.depth.min() * (1 - 1e-6)


def test_a_prediction_that_is_unknown_wherever_the_truth_is_known():
    room, sequence = room_and_truth()
    scores = score(dataclasses.replace(room, depth=np.zeros_like(room.depth)), TruthAtPixels(sequence, room))
    assert scores.problems == ()
    assert {note.split(": ")[1] for note in scores.notes} == {"no pixel with a true depth has a predicted one"}
