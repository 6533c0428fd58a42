"""The frames of windows: read as they are needed, and warned about once."""

import logging
from collections.abc import Iterator

import numpy as np
from PIL import Image

from tests.clips.test_video import write_video
from vggtjax.clips.preprocessing import Fitter
from vggtjax.clips.sampling import Frame, Sampling
from vggtjax.clips.sources import open_source
from vggtjax.clips.video import VideoFile
from vggtjax.windows.frames import count_frames, window_clips
from vggtjax.windows.plan import plan_windows


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


def test_what_is_cut_off_is_told_once(tmp_path, caplog):
    for number in range(12):
        Image.fromarray(np.full((90, 40, 3), number, np.uint8)).save(tmp_path / f"{number:02d}.png")
    cut = plan_windows(12, 4, 2)
    with caplog.at_level(logging.WARNING):
        clips = list(window_clips(open_source(str(tmp_path)), Sampling(), Fitter(size=64, patch=8), cut))
    assert len(clips) == 5
    assert caplog.text.count("lose") == 1
