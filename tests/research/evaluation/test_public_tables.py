"""Numbers of public evaluations, run once on random poses, tracks and masks, and stored in tests/golden/evaluation.

camera_pairs.npz: VGGT's evaluation/test_co3d.py (its author's commit 4b8be14b, as the fork yhomasti/vggt has it; the
functions are those of facebookresearch/vggt 851d2571), Pi3's relpose/metric.py (yyfz/Pi3 97ce97b8), Depth Anything 3's
bench/utils.py (ByteDance-Seed/Depth-Anything-3 2c21ea84), SuperGlue's models/utils.py
(magicleap/SuperGluePretrainedNetwork ddcf11f4). tracks.npz: TAPVid-3D's evaluation/metrics.py (google-deepmind/tapnet
c2cbab81) and St4RTrack's dust3r/track_eval_util.py (a copy of HavenFeng/St4RTrack, zhaoliangzhang/St4RTrack 0a4ebfdd).
masks_easi3r.npz: davis2017/evaluation.py of Easi3R (Inception3D/Easi3R 146a77d7), which mask_metric.py runs.
"""

import dataclasses
from typing import get_args

import numpy as np
import pytest

from tests.shared.dataset_files import opened
from tests.shared.golden import GOLDEN
from tests.shared.scored_room import room_and_truth
from vggtjax.cameras import world_from_camera
from vggtjax.errors import InputError
from vggtjax.research.evaluation import pair_angles, pair_scores, recall_area, tapvid3d_scores, world_track_errors
from vggtjax.research.evaluation.datasets.true_tracks import TrueTracks
from vggtjax.research.evaluation.metrics.camera_pairs import THRESHOLDS
from vggtjax.research.evaluation.metrics.masks import pooled_scores
from vggtjax.research.evaluation.metrics.tracks import TrackAlign
from vggtjax.research.evaluation.protocol import score
from vggtjax.research.evaluation.truth_at_pixels import TruthAtPixels
from vggtjax.training.scenes.config import SceneConfig
from vggtjax.training.scenes.dataset import write_scenes


def public(name):
    return np.load(GOLDEN / "evaluation" / f"{name}.npz", allow_pickle=False)


@pytest.mark.parametrize("pairs", ["vggt", "pi3", "da3", "matching"])
def test_pairs_of_cameras_are_those_of_public_code(pairs):
    golden, name = public("camera_pairs"), "superglue" if pairs == "matching" else pairs
    poses = golden["found"][:, :3], golden["true"][:, :3]
    angles, scores = pair_angles(*poses, pairs), pair_scores(*poses, pairs)
    np.testing.assert_allclose(angles.rotation, golden[f"{name}_rotation"], atol=1e-6)
    np.testing.assert_allclose(angles.translation, golden[f"{name}_translation"], atol=1e-6)
    for kind in ("auc", "rra", "rta"):
        made = [scores[f"{kind}_{limit}"] for limit in THRESHOLDS]
        np.testing.assert_allclose(made, golden[f"{name}_{kind}"], atol=1e-6)


def test_areas_and_angles_by_hand():
    assert recall_area(np.array([0.5, 2.5, 40]), 3) == pytest.approx((1 + 1 + 2) / 9)  # recalls at 1, 2 and 3 degrees
    exact = recall_area(np.array([1.0, 4.0]), 2, is_binned=False)  # a triangle up to 1, then level
    assert exact == pytest.approx((0.25 + 0.5) / 2)
    assert recall_area(np.zeros(4), 3) == recall_area(np.zeros(4), 3, is_binned=False) == 1
    poses = np.tile(np.eye(3, 4), (3, 1, 1))
    poses[:, 0, 3] = [0, 1, 3]
    backwards = poses * np.array([1, 1, 1, -1.0])  # a direction counts up to its sign
    assert set(pair_scores(backwards, poses).values()) == {1}
    still = pair_angles(np.tile(np.eye(3, 4), (3, 1, 1)), poses)  # without a direction
    assert still.translation.tolist() == [90, 90, 90]
    with pytest.raises(InputError, match="1 predicted poses and 3 true ones"):
        pair_angles(poses[:1], poses)


def test_tracks_are_scored_as_by_public_code():
    golden = public("tracks")
    focal = float(np.sqrt(golden["intrinsics"][0] * golden["intrinsics"][1]))
    found, true, found_visible, visible = (golden[name] for name in ("found", "true", "found_visible", "visible"))
    scores = tapvid3d_scores(found, true, found_visible, visible, focal)
    for name, value in scores._asdict().items():
        assert value == pytest.approx(golden[f"tapvid3d_{name}"].item(), abs=1e-6)
    unknown = ~visible & ~found_visible  # say that their depth is unknown: they do not count
    counted = tapvid3d_scores(found, true, found_visible, visible, focal, ~unknown)
    assert counted.oa == pytest.approx((visible & found_visible).sum() / (visible | found_visible).sum())
    assert (counted.apd, counted.aj) == (scores.apd, scores.aj)
    every = np.ones(visible.shape, bool)
    for align in get_args(TrackAlign):
        errors = world_track_errors(golden["world_found"], true, every, align)
        assert errors.apd == pytest.approx(golden[f"worldtrack_{align}_apd"].item(), abs=1e-6)
        assert errors.epe == pytest.approx(golden[f"worldtrack_{align}_epe"].item(), abs=1e-6)
    with pytest.raises(InputError, match="no point is visible in both"):
        tapvid3d_scores(found, true, ~visible, visible, focal)


def test_masks_of_easi3r_count_each_frame_once():
    golden = public("masks_easi3r")
    sequences = []
    for name in ("a", "b"):
        shape = golden[f"shape_{name}"]
        sequences.append(np.unpackbits(golden[f"bits_{name}"])[: shape.prod()].reshape(shape).astype(bool))
    scores = pooled_scores([(predicted, truth) for predicted, truth in sequences])
    for name in ("j_mean", "j_recall", "f_mean", "f_recall"):
        assert getattr(scores, name) == pytest.approx(float(golden[name]), abs=1e-6)


def tracked_room(step=6):
    """The room, with tracks of its wall: where the first frame shows it at the centres of pixels."""
    room, sequence = room_and_truth()
    poses, S = room.world_from_camera.astype(np.float64), len(room.depth)
    points = room.world_points().astype(np.float64)[0, 2::step, 2::step].reshape(-1, 3)
    points = points[np.abs(points[:, 2] - 5) < 1e-3]
    seen = np.zeros((S, len(points)), bool)
    for frame in range(S):
        camera = (points - poses[frame, :3, 3]) @ poses[frame, :3, :3]
        x, y = (camera[:, :2] / camera[:, 2:] * room.intrinsics[frame, 0, 0] + room.intrinsics[frame, :2, 2]).T
        inside = (x >= 0) & (y >= 0) & (x < room.depth.shape[2]) & (y < room.depth.shape[1])
        seen[frame, inside] = ~room.dynamic_mask[frame, y[inside].astype(int), x[inside].astype(int)]
    tracks = TrueTracks(np.tile(points, (S, 1, 1)), seen)
    return room, dataclasses.replace(sequence, tracks=tracks), tracks


def test_a_perfect_result_follows_points_perfectly():
    room, sequence, tracks = tracked_room()
    cameras = world_from_camera(room.world_from_camera[:, :3])[:, :3]
    camera = np.einsum("sij,snj->sni", cameras[:, :, :3], tracks.points) + cameras[:, None, :, 3]
    places = (
        camera[..., :2] / camera[..., 2:] * room.intrinsics[:, None, [0, 1], [0, 1]] + room.intrinsics[:, None, :2, 2]
    )
    first = np.flatnonzero(tracks.visible[0])
    followed = dataclasses.replace(
        room,
        track_positions=places[:, first].astype(np.float32),
        track_visibility=tracks.visible[:, first].astype(np.float32),
        track_confidence=np.ones((4, len(first)), np.float32),
        track_frames=np.zeros(len(first), np.int64),
    )
    metrics = score(followed, TruthAtPixels(sequence, room)).metrics
    for kind in ("tracks", "dense"):
        assert metrics[f"{kind}_world_epe"] < 0.02  # the depth is that of the pixel's centre
        assert metrics[f"{kind}_sim3_epe"] < 0.02
        assert metrics[f"{kind}_world_apd"] == metrics[f"{kind}_sim3_apd"] == 1
        assert metrics[f"{kind}_apd"] > 0.95
    assert metrics["tracks_oa"] == 1
    assert {metrics[f"auc_{limit}"] for limit in THRESHOLDS} == {1}

    scores = score(room, TruthAtPixels(sequence, room))
    assert [note for note in scores.notes if note.startswith("tracks: the result has no tracks; follow")]
    moved = dataclasses.replace(followed, track_positions=places[:, first].astype(np.float32) + 12)
    worse = score(moved, TruthAtPixels(sequence, room)).metrics
    assert worse.get("tracks_world_epe", 1) > 0.05


def test_tracks_of_a_generated_scene_move_by_its_flow(tmp_path):
    write_scenes(tmp_path, SceneConfig(height=48, width=64, frames=4), count=1, seed=5)
    (sequence,) = opened("plain", tmp_path)
    tracks, parts = sequence.tracks, sorted((tmp_path / "scene_0000/parts").iterdir())
    assert tracks.visible[0].all()
    assert 0.3 < tracks.visible[1:].mean() < 1
    flow = np.load(sorted((tmp_path / "scene_0000/flow").iterdir())[0])[4::8, 4::8].reshape(-1, 3)
    np.testing.assert_allclose(tracks.points[1] - tracks.points[0], flow, atol=1e-4)
    assert np.abs(flow).max() > 0.01
    assert len(parts) == len(tracks.points) == 4
