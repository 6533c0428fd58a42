import gc
import struct

import av
import numpy as np
import pytest
from av.stream import Disposition

from tests.shared.videos import HEIGHT, WIDTH, encode, picture, write_video
from vggtjax.clips.media.sampling import Sampling
from vggtjax.clips.media.video import VideoFile, upright
from vggtjax.errors import ClipError

# Upper left (a, b, c, d) of a display matrix, x' = a x + c y and y' = b x + d y with y down, and what FFmpeg's filters
# of the same names make of the rows abc and def.
ORIENTATIONS = {
    (1, 0, 0, 1): ["abc", "def"],  # as stored
    (0, 1, -1, 0): ["da", "eb", "fc"],  # 90 degrees clockwise
    (-1, 0, 0, -1): ["fed", "cba"],
    (0, -1, 1, 0): ["cf", "be", "ad"],  # counterclockwise
    (-1, 0, 0, 1): ["cba", "fed"],  # mirrored
    (1, 0, 0, -1): ["def", "abc"],  # upside down
    (0, 1, 1, 0): ["ad", "be", "cf"],  # transposed
    (0, -1, -1, 0): ["fc", "eb", "da"],
}


def orient(path, matrix):
    """Put another display matrix into the track header of an MP4 file."""
    unit = struct.pack(">9i", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    a, b, c, d = (round(value * (1 << 16)) for value in matrix)
    data = path.read_bytes()
    track = data.index(b"tkhd")
    place = data.index(unit, track)
    path.write_bytes(data[:place] + struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30) + data[place + len(unit) :])
    return path


def read(path, **values):
    return list(VideoFile(path).frames(Sampling(**values)))


def seconds(frames):
    """Return the times of frames as an array."""
    return np.array([frame.time for frame in frames], np.float64)


@pytest.fixture(scope="module")
def even(tmp_path_factory):
    """Twenty frames, 10 a second."""
    return write_video(tmp_path_factory.mktemp("video") / "even.mp4", range(0, 2000, 100))


def test_every_frame(even):
    frames = read(even)
    assert [frame.name for frame in frames] == [f"{index:06d}" for index in range(20)]
    np.testing.assert_allclose(seconds(frames), np.arange(20) / 10, atol=1e-3)
    for index, frame in enumerate(frames):
        assert np.abs(np.asarray(frame.image).astype(int) - picture(index)).mean() < 12
    assert VideoFile(even).total(Sampling()) is None


@pytest.mark.parametrize("ending", ["mp4", "mkv"])
def test_times_of_a_variable_frame_rate(tmp_path, ending):
    times = [0, 40, 100, 500, 520, 1000, 1300, 1540]
    path = write_video(tmp_path / f"uneven.{ending}", [5000 + time for time in times])  # they count from the first
    np.testing.assert_allclose(seconds(read(path)), np.array(times) / 1000, atol=1e-3)
    assert [int(frame.name) for frame in read(path, fps=2)] == [0, 3, 5, 7]
    assert [int(frame.name) for frame in read(path, start=1, stride=3, max_frames=2)] == [1, 4]


@pytest.mark.parametrize(("matrix", "expected"), ORIENTATIONS.items())
def test_quarter_turns_by_hand(matrix, expected):
    pixels = np.array([list("abc"), list("def")])[..., None]
    shown = upright(pixels, np.reshape(matrix, (2, 2)))
    assert ["".join(row) for row in shown[..., 0]] == expected


def test_the_rotation_of_a_telephone(tmp_path):
    # Held upright, its sensor lies on its side: the left of what is stored is the top of what is seen.
    image = read(orient(write_video(tmp_path / "portrait.mp4", [0]), (0, 1, -1, 0)))[0].image
    assert image.size == (HEIGHT, WIDTH)
    red = np.asarray(image)[..., 0].astype(int)
    assert red[: WIDTH // 2 - 2].min() > 150
    assert red[WIDTH // 2 + 2 :].max() < 50


def test_a_matrix_that_is_no_quarter_turn(tmp_path):
    path = orient(write_video(tmp_path / "tilted.mp4", [0]), (0.97, 0.26, -0.26, 0.97))
    with pytest.raises(ClipError, match=r"shown turned by -?\d+ degrees; expected a multiple of 90"):
        read(path)


@pytest.fixture
def broken(tmp_path):
    """A video whose packets end in the middle, though its header speaks of twenty frames; and the packets left."""
    path = write_video(tmp_path / "broken.mp4", range(0, 2000, 100), movflags="faststart")
    with av.open(str(path)) as container:
        ends = [(packet.pos or 0) + packet.size for packet in container.demux(video=0) if packet.size]
    return path, ends


def test_a_video_that_breaks_off_within_a_frame(broken, monkeypatch):
    path, ends = broken
    path.write_bytes(path.read_bytes()[: ends[8] - 2])
    with pytest.raises(ClipError, match=r"broken.mp4 breaks off at frame 8 .*, or take only frames before 8"):
        read(path)
    assert len(read(path, max_frames=8)) == 8  # nothing after the last frame taken is looked at
    monkeypatch.setattr("vggtjax.clips.media.video._MOST_PIXELS", WIDTH * HEIGHT - 1)
    with pytest.raises(ClipError, match=f"has frames of {WIDTH} x {HEIGHT}"):
        read(path)


def test_files_that_are_no_video(tmp_path, even):
    path = tmp_path / "a.mp4"
    with pytest.raises(ClipError, match=r"cannot read video .*a.mp4: No such file"):
        read(path)
    path.write_bytes(b"no video")
    with pytest.raises(ClipError, match=r"cannot read video .*a.mp4: Invalid data"):
        read(path)
    # A program stream need not say when each frame is shown, and this one's rate does not tell either.
    with pytest.raises(ClipError, match=r"frame 1 of video .* has no presentation time; write the video as MP4"):
        read(write_video(tmp_path / "untimed.mpg", range(0, 500, 100)))
    path.write_bytes(even.read_bytes()[:200])
    with pytest.raises(ClipError, match=r"a.mp4"):
        read(path)


def test_a_playlist_is_not_followed(tmp_path, even):
    path, entry = tmp_path / "list.mp4", f"#EXTINF:2,\n{even}\n#EXT-X-ENDLIST\n"
    for text in (f"ffconcat version 1.0\nfile {even}\n", f"#EXTM3U\n#EXT-X-TARGETDURATION:2\n{entry}"):
        path.write_text(text)
        with pytest.raises(ClipError, match="cannot read video"):
            read(path)


def test_sound_and_a_cover_are_no_video(tmp_path):
    path = tmp_path / "sound.mp4"
    with av.open(str(path), "w") as container:
        sound, cover = container.add_stream("aac", rate=16000), container.add_stream("mjpeg", rate=1)
        cover.width, cover.height, cover.pix_fmt = WIDTH, HEIGHT, "yuvj420p"
        cover.disposition = Disposition.attached_pic
        container.mux(cover.encode(av.VideoFrame.from_ndarray(picture(0), format="rgb24")))
        container.mux(cover.encode())
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 16000
        container.mux(sound.encode(frame))
        container.mux(sound.encode())
    with pytest.raises(ClipError, match=r"sound.mp4 has no video stream"):
        read(path)


def test_of_two_videos_the_one_that_is_read_is_said(tmp_path, caplog):
    path = tmp_path / "two.mp4"
    with av.open(str(path), "w") as container:
        streams = [container.add_stream("mpeg4", rate=10) for _ in range(2)]
        for stream in streams:
            stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for stream in streams:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture(0), format="rgb24")))
            container.mux(stream.encode())
    read(path)
    sizes = f"{WIDTH} x {HEIGHT}"
    assert f"holds 2 videos ({sizes}, {sizes}); that of {sizes} is read" in caplog.text


def test_frames_are_let_go(even):
    """A frame of the decoder must not wait for the garbage collector: at 4K each is 12 MB."""
    gc.collect()
    gc.disable()
    try:
        read(even)
        assert not [thing for thing in gc.get_objects() if type(thing) is av.VideoFrame][1:]
    finally:
        gc.enable()


@pytest.mark.parametrize(("codec", "pixels"), [("qtrle", "argb"), ("prores_ks", "yuva444p10le"), ("png", "rgb24")])
def test_what_is_transparent_is_white_as_in_pictures(tmp_path, codec, pixels):
    path = tmp_path / "a.mov"
    colours = np.dstack([picture(5), np.full((HEIGHT, WIDTH), 255, np.uint8)])
    colours[:, WIDTH // 2 :, 3] = 0
    encode(path, [colours], codec, pixels)
    frame = np.asarray(read(path)[0].image).astype(int)
    is_clear = codec != "png"
    np.testing.assert_allclose(frame[:, WIDTH // 2 + 4 :], 255 if is_clear else picture(5)[:, WIDTH // 2 + 4 :], atol=6)
    np.testing.assert_allclose(frame[:, : WIDTH // 2 - 4], picture(5)[:, : WIDTH // 2 - 4], atol=6)
