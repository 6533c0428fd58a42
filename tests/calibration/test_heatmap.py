"""The picture of a calibration."""

import numpy as np

from vggtjax import Cue, MotionConfig
from vggtjax.calibration.choice import Choice, Rating, Step
from vggtjax.calibration.heatmap import draw_sweep


def test_cues_that_begin_in_one_cell_are_all_numbered():
    def green(count):
        """Green pixels in a row of pixels below the text of the label: two edges of the cell, and the label."""
        steps = (Step(Cue("cue", "q", "q", (0,), "mean"), Rating(0.7, 0.7)),) * count
        drawn = draw_sweep(np.full((2, 6, 3), 0.5), Choice(MotionConfig(), "cosine", steps, None, Rating(0.5, 0.5)))
        return int((drawn[24 + 96 + 11] == (30, 200, 90)).all(axis=-1).sum())

    assert green(0) == 0 < green(1) < green(2) < green(3)
