from collections.abc import Iterator
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.shared.videos import write_video
from vggtjax.clips.media.sampling import Frame, Sampling
from vggtjax.clips.media.video import VideoFile
from vggtjax.clips.preprocessing import Fitter
from vggtjax.pipeline.windows.frames import count_frames, window_clips
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
    assert (windows[0].start, windows[-1].stop) == (0, frames)
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


class Watched(VideoFile):
    """A video that counts the frames it decoded."""

    decoded = 0

    def frames(self, sampling: Sampling) -> Iterator[Frame]:
        for frame in super().frames(sampling):
            Watched.decoded += 1
            yield frame


def test_frames_of_a_video_are_decoded_when_their_window_is_due(tmp_path):
    video = Watched(write_video(tmp_path / "clip.mp4", range(0, 2000, 100)))
    cut = plan_windows(20, 8, 2)
    Watched.decoded = 0
    for window, clip in zip(cut, window_clips(video, Sampling(), Fitter(size=64, patch=8), cut), strict=True):
        assert Watched.decoded == window.stop
        assert clip.frame_names == [f"{number:06d}" for number in window]
    Watched.decoded = 0
    assert count_frames(video, Sampling(), most=5) == Watched.decoded == 5
    assert count_frames(video, Sampling(stride=2)) == 10
