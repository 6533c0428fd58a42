"""Depth and focal length from known poses: a painted room gets back what was distorted, and keeps what was right."""

import numpy as np
import pytest

from tests.shared.textured_room import textured_room
from vggtjax.pipeline.known.consistency import consistent_with_poses

ROOM = textured_room(4)
STATIC = ~ROOM.dynamic_mask


def test_what_is_right_stays_as_it_is():
    broken = np.where(ROOM.dynamic_mask, np.float32(30), ROOM.depth)  # movers do not count
    made = consistent_with_poses(textured_room(4, depth=broken), focal_known=False)
    assert made.focal == 1
    np.testing.assert_array_equal(made.depth[STATIC], 1)


def test_one_scale_and_a_smooth_distortion_are_undone():
    across = np.linspace(-1, 1, 84)
    distorted = textured_room(4, depth=ROOM.depth * 1.5 * np.exp(0.35 * across).astype(np.float32))
    made = consistent_with_poses(distorted, focal_known=True)
    left = np.abs(made.depth * distorted.depth / ROOM.depth - 1)[STATIC]
    assert left.mean() < 0.05
    assert made.cost[1] < made.cost[0]


@pytest.mark.proof
def test_a_wrong_focal_length_is_found():
    wrong = textured_room().intrinsics.copy()
    wrong[:, [0, 1], [0, 1]] *= 1.2
    made = consistent_with_poses(textured_room(intrinsics=wrong), focal_known=False)
    assert made.focal == pytest.approx(1 / 1.2, rel=0.04)
