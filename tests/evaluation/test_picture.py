"""The picture of a result next to its truth."""

import numpy as np

from tests.room import make_room
from vggtjax.clips.truth import Truth
from vggtjax.evaluation.picture import truth_sheet


def test_a_result_is_drawn_next_to_its_truth():
    result = make_room(frames=4)
    truth = Truth(
        result.images / np.float32(255),
        2 * result.depth,  # another scale, which is aligned away
        result.dynamic_mask,
        result.camera_from_world,
        result.intrinsics,
    )
    sheet = truth_sheet(result, truth)
    assert sheet.dtype == np.uint8
    width, height = 220, round(220 * 28 / 42)
    top, left, step = 24 + 40, 24 + 130, height + 6
    found, true = (sheet[top + row * step :][:height, left:][:, :width] for row in (1, 2))
    assert np.abs(found.astype(int) - true).max() <= 4
    assert (found != sheet[0, 0]).any()
