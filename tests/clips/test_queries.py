"""Points to track, from the command line's words to files; the tracker itself is tested in test_track_head."""

import dataclasses

import numpy as np
import pytest
from PIL import Image

from tests.shared.seeded import seeded_images
from tests.shared.tiny import tiny_model
from vggtjax import Reconstruction, load_clip, reconstruct
from vggtjax.clips.queries import Queries, check_words, parse_queries
from vggtjax.errors import InputError, ResultError

pytestmark = pytest.mark.filterwarnings("ignore:the field of view")  # seeded weights give odd cameras

POINTS = Queries(np.array([[10, 12], [40, 30], [5.5, 50], [33, 33]]), np.array([0, 2, 0, 2]))


@pytest.fixture(scope="module")
def clip():
    return load_clip(seeded_images(3, 56, 56, seed=4).transpose(0, 2, 3, 1), size=56)


@pytest.fixture(scope="module")
def tracked(clip) -> Reconstruction:
    return reconstruct(tiny_model(), clip, size=56, method="vggt", tracks=POINTS)


def test_points_of_any_frame(clip, tracked):
    """Points of frame 2 are tracked as those of the first frame in a clip that begins with frame 2."""
    chosen = POINTS.frames == 2
    turned = dataclasses.replace(clip, images=np.roll(clip.images, -2, axis=0))
    first = Queries(POINTS.points[chosen], np.zeros(2, int))
    made = reconstruct(tiny_model(), turned, size=56, method="vggt", tracks=first)
    back = np.roll(np.asarray(made.track_positions), 2, axis=0)
    assert np.abs(tracked.track_positions[:, chosen] - back).max() < 2e-2  # sines of a thousand times the flow
    for frame in (0, 2):
        chosen = POINTS.frames == frame
        assert np.array_equal(tracked.track_positions[frame, chosen], POINTS.points[chosen])
    assert np.array_equal(tracked.track_frames, POINTS.frames)
    assert tracked.track_visibility.shape == tracked.track_confidence.shape == (3, 4)


def test_tracks_survive_a_round_trip(tmp_path, tracked, clip):
    tracked.save(tmp_path / "out")
    loaded = Reconstruction.load(tmp_path / "out")
    for name in ("track_positions", "track_visibility", "track_confidence", "track_frames"):
        assert np.array_equal(getattr(loaded, name), getattr(tracked, name))
    with np.load(tmp_path / "out/tracks.npz") as file:
        assert set(file) == {"positions", "visibility", "confidence", "frames"}
        for frame in range(3):
            there = clip.to_source(frame, tracked.track_positions[frame])
            assert np.allclose(file["positions"][frame], there, atol=1e-3)
    strip = np.asarray(Image.open(tmp_path / "out/preview/tracks.png"))
    assert strip.shape[1] > 1700
    assert strip.std() > 10
    video = load_clip(str(tmp_path / "out/preview/tracks.mp4"), size=56)
    assert len(video) == 3

    fields = [field.name for field in dataclasses.fields(Reconstruction) if field.name.startswith("track_")]
    dataclasses.replace(tracked, **dict.fromkeys(fields)).save(tmp_path / "out", only=())
    assert not (tmp_path / "out/tracks.npz").exists()
    assert Reconstruction.load(tmp_path / "out").track_positions is None
    with pytest.raises(ResultError, match="tracks lack track_visibility"):
        dataclasses.replace(tracked, track_visibility=None)
    with pytest.raises(ResultError, match="track_positions has shape"):
        dataclasses.replace(tracked, track_positions=tracked.track_positions[:, :2])


def test_a_grid_lies_inside_the_picture():
    clip = load_clip(np.zeros((2, 90, 160, 3), np.uint8), size=56, mode="pad")
    box = clip.valid_box[0].reshape(2, 2)  # corners
    queries = parse_queries("grid:3", clip)
    assert len(queries.points) == 9
    assert not queries.frames.any()
    rim = (box[1] - box[0]) / 6
    assert np.allclose([queries.points.min(axis=0), queries.points.max(axis=0)], [box[0] + rim, box[1] - rim])


def test_a_file_of_points_in_pixels_of_the_source(tmp_path):
    clip = load_clip(np.zeros((3, 90, 160, 3), np.uint8), size=56)
    (tmp_path / "points.csv").write_text("x,y,frame\n80,45,0\n10.5,20,2\n", encoding="utf-8")
    queries = parse_queries(str(tmp_path / "points.csv"), clip)
    assert queries.frames.tolist() == [0, 2]
    assert np.allclose(clip.to_source(0, queries.points), [[80, 45], [10.5, 20]], atol=1e-4)
    assert np.allclose(queries.moved(clip, clip.refit(28, 14)).points, queries.points / 2, atol=0.5)
    (tmp_path / "plain.csv").write_text("\ufeffx,y\n80,45\n", encoding="utf-8")
    assert parse_queries(str(tmp_path / "plain.csv"), clip).frames.tolist() == [0]


def test_bad_files_of_points(tmp_path):
    for text, said in (
        ("x,y\n", "holds no points"),
        ("a,b\n1,2\n", "expected columns x, y"),
        ("x,y,frame\n1,2,9\n", "a frame from 0 to 1"),
        ("x,y\n1000,2\n", r"line 2: \(1000, 2\) lies outside"),
    ):
        clip = load_clip(np.zeros((2, 90, 160, 3), np.uint8), size=56)
        (tmp_path / "points.csv").write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match=said):
            parse_queries(str(tmp_path / "points.csv"), clip)
    with pytest.raises(InputError, match="there are 10001 points"):
        Queries(np.zeros((10_001, 2)), np.zeros(10_001))
    for words in ("grid:4000", "grid:" + "9" * 5000, "grid:x", "missing.csv"):
        with pytest.raises(InputError, match="tracks is"):
            parse_queries(words, clip)
        with pytest.raises(InputError, match="tracks is"):
            check_words(words)
