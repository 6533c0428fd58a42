"""Data sets on real footage: geometry that agrees between frames."""

import numpy as np
import pytest

from tests.dataset_files import opened


def lifted(sequence, frame, step=4):
    """World points [N, 3] of every step-th pixel with depth; pixels have their centres at one half."""
    depth = sequence.depth(frame)
    rows, columns = (part.ravel() for part in np.mgrid[: depth.shape[0] : step, : depth.shape[1] : step])
    z = depth[rows, columns]
    rays = np.stack([columns + 0.5, rows + 0.5, np.ones(len(z))], -1) @ np.linalg.inv(sequence.intrinsics[frame]).T
    points = (rays * z[:, None])[z > 0]
    pose = sequence.world_from_camera[frame]
    return points @ pose[:3, :3].T + pose[:3, 3]


def depth_differences(sequence, source, target):
    """Relative differences of the depth of one frame, seen from another, from what that one measured there."""
    pose = np.linalg.inv(sequence.world_from_camera[target])
    points = lifted(sequence, source) @ pose[:3, :3].T + pose[:3, 3]
    points = points[points[:, 2] > 0.1]
    x, y = np.floor((points @ sequence.intrinsics[target].T)[:, :2] / points[:, 2:]).astype(int).T
    depth = sequence.depth(target)
    seen = (x >= 0) & (y >= 0) & (x < depth.shape[1]) & (y < depth.shape[0])
    measured, expected = depth[y[seen], x[seen]], points[seen, 2]
    known = measured > 0
    assert known.sum() > 500
    return np.abs(expected - measured)[known] / measured[known]


@pytest.mark.parametrize("take", [0, 1])
def test_depth_poses_and_intrinsics_of_hololens_agree(clips, take):
    sequence = opened("hololens", clips / "hololens")[take]
    assert np.median(depth_differences(sequence, 4, 6)) < 0.006
    turned = sequence.world_from_camera.copy()
    turned[:, :3, :3] = turned[:, :3, :3].swapaxes(1, 2)  # what reading poses the wrong way round would do
    wrong = type(sequence)("wrong", sequence.pictures, sequence.depth, None, turned, sequence.intrinsics)
    assert np.median(depth_differences(wrong, 4, 6)) > 0.04


def test_depth_poses_and_intrinsics_of_tum_agree(clips, tmp_path):
    link = tmp_path / "rgbd_dataset_freiburg1_rpy"
    link.mkdir()
    for name in ("rgb", "depth", "rgb.txt", "depth.txt", "groundtruth.txt"):
        (link / name).symlink_to(clips / "tum" / name)
    (sequence,) = opened("tum", tmp_path, stride=1)
    assert sequence.name == "freiburg1_rpy"
    assert len(sequence) == 40
    assert np.allclose(sequence.intrinsics[7], [[517.3, 0, 319.1], [0, 516.5, 255.8], [0, 0, 1]])
    assert np.allclose(np.diff(sequence.timestamps), 1 / 30, atol=0.02)
    assert np.median(depth_differences(sequence, 5, 12)) < 0.02
    moved = sequence.intrinsics.copy()
    moved[:, :2, 2] -= 60
    wrong = type(sequence)("wrong", sequence.pictures, sequence.depth, None, sequence.world_from_camera, moved)
    assert np.median(depth_differences(wrong, 5, 12)) > 0.025
