"""A frame of two windows by hand."""

import dataclasses

import numpy as np

from tests.pipeline.windows.test_extend import part_of_walk
from tests.pipeline.windows.walk import CONFIG, FRAMES, window_result
from vggtjax.cameras import Similarity
from vggtjax.pipeline.windows.blend import WindowView, blend_frame


def test_a_view_that_does_not_know_a_pixel_leaves_it_to_the_other():
    moving = np.zeros((FRAMES, CONFIG.height, CONFIG.width), bool)
    whole = window_result(part_of_walk(slice(0, 2)), 0, moving)
    confidence = 3 * whole.depth_confidence
    confidence[0, 0, 0], confidence[0, 1, 1] = np.nan, np.inf
    holed = dataclasses.replace(whole, depth_confidence=confidence)
    same = Similarity(1.0, np.eye(3), np.zeros(3))
    views = [WindowView(whole, 0, same, 0.25), WindowView(holed, 0, same, 0.75)]
    blended = blend_frame(views)
    assert blended.depth_confidence[0, 0] == blended.depth_confidence[1, 1] == whole.depth_confidence[0, 0, 0]
    assert blended.depth_confidence[2, 2] == 2.5  # of 1 and 3
    np.testing.assert_allclose(blended.depth, whole.depth[0], rtol=1e-6)
    alone = blend_frame([WindowView(holed, 0, same, 1.0)])
    assert np.isnan(alone.depth_confidence[0, 0])
