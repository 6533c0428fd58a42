"""The frames of windows: read as they are needed, and warned about once."""

from collections.abc import Iterator

from tests.shared.videos import write_video
from vggtjax.clips.media.sampling import Frame, Sampling
from vggtjax.clips.media.video import VideoFile
from vggtjax.clips.preprocessing import Fitter
from vggtjax.pipeline.windows.frames import count_frames, window_clips
from vggtjax.pipeline.windows.plan import plan_windows


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
