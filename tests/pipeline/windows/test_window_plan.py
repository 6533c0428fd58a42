"""Which frames each window has."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vggtjax.pipeline.windows.plan import Windows, blend_weights, plan_windows, shared_frames


def test_a_plan_by_hand():
    assert plan_windows(20, 8, 2) == [range(8), range(6, 14), range(12, 20)]
    assert plan_windows(9, 8, 2) == [range(8), range(1, 9)]  # the last window is as long as the first
    assert shared_frames(range(8), range(6, 14)) == range(6, 8)
    windows = Windows(16)
    assert (windows.shared, windows.cuts(16), windows.cuts(17)) == (4, False, True)


@given(window=st.integers(4, 40), data=st.data())
def test_every_plan_covers_the_clip_with_equal_windows_and_as_few_as_can_be(window, data):
    overlap = data.draw(st.integers(2, window // 2))
    frames = data.draw(st.integers(window + 1, 400))
    windows = plan_windows(frames, window, overlap)
    assert windows[0].start == 0
    assert windows[-1].stop == frames
    assert {len(w) for w in windows} == {window}
    assert all(len(shared_frames(a, b)) >= overlap for a, b in pairwise(windows))
    assert frames > (len(windows) - 1) * (window - overlap) + overlap  # one window fewer does not reach the end


@given(window=st.integers(4, 30), frames=st.integers(31, 120))
def test_weights_of_a_frame_sum_to_one_and_fall_towards_the_end_of_a_window(window, frames):
    windows = plan_windows(frames, window, max(2, window // 4))
    table = [blend_weights(frame, windows) for frame in range(frames)]
    assert all(sum(weights.values()) == pytest.approx(1) for weights in table)
    for a, b in zip(range(len(windows)), range(1, len(windows)), strict=False):
        both = [weights[a] - weights[b] for weights in table if set(weights) == {a, b}]
        assert both == sorted(both, reverse=True)
