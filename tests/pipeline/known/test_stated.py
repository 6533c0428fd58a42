"""Known intrinsics: their files, and the focal length that cameras write into EXIF and QuickTime's metadata."""

import dataclasses
import re
from contextlib import suppress

import av
import numpy as np
import pillow_heif
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from tests.shared.room import make_room
from vggtjax import load_clip
from vggtjax.clips.media.focal import picture_focal
from vggtjax.errors import InputError
from vggtjax.interface.commands import main as cli
from vggtjax.pipeline.known.apply import apply_known
from vggtjax.pipeline.known.given import read_known
from vggtjax.pipeline.known.intrinsics import at_clip_pixels, known_values, read_intrinsics, shared_focal
from vggtjax.pipeline.known.options import KnownGeometry
from vggtjax.pipeline.known.stated import disagreement, focal_stated, stated_intrinsics

FILM, FOCAL, PLANE, UNIT, ZOOM, WIDTH, HEIGHT = 0xA405, 0x920A, 0xA20E, 0xA210, 0xA404, 0xA002, 0xA003
EXIF = KnownGeometry(intrinsics="exif")
SENSOR = {FOCAL: IFDRational(50, 10), PLANE: IFDRational(4000, 6), UNIT: 4, WIDTH: 4000, HEIGHT: 3000}  # 6 x 4.5 mm


def write(path, tags, size=(400, 300), orientation=1):
    """A picture as a camera writes it; `size` is that of the stored pixels."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif.get_ifd(0x8769).update(tags)
    if path.suffix == ".heic":
        pillow_heif.register_heif_opener()
    Image.new("RGB", size, "green").save(path, exif=exif)
    return path


def write_video(path, focal):
    with av.open(str(path), "w", options={"movflags": "use_metadata_tags"}) as container:
        container.metadata["com.apple.quicktime.camera.focal_length.35mm_equivalent"] = focal
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for frame in [av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8))] * 2 + [None]:
            container.mux(stream.encode(frame))


@pytest.mark.parametrize(
    ("tags", "pixels"),
    [
        ({FILM: 26}, 26 * 500 / np.hypot(36, 24)),
        ({FILM: 52, ZOOM: 2.0, WIDTH: 4000, HEIGHT: 3000}, 52 * 500 / np.hypot(36, 24)),  # zoom is in it; made smaller
        (SENSOR, 5 * 400 / 6),
        (SENSOR | {FILM: 0}, 5 * 400 / 6),  # 0: unknown
        (SENSOR | {ZOOM: 1.5}, 1.5 * 5 * 400 / 6),
        (SENSOR | {ZOOM: IFDRational(0, 0)}, 5 * 400 / 6),
        ({FOCAL: 5.0, PLANE: 1e4 / 2.54, UNIT: 2}, 5 * 1e4 / 2.54 / 25.4),  # an inch; no size when it was taken
        ({FOCAL: 5.0, PLANE: 1e4 / 2.54}, 5 * 1e4 / 2.54 / 25.4),
    ],
)
def test_pixels_of_what_a_picture_states(tmp_path, tags, pixels):
    assert picture_focal(write(tmp_path / "a.jpg", tags)).pixels == pytest.approx(pixels, rel=1e-5)


@pytest.mark.parametrize("ending", [".jpg", ".heic"])
def test_a_turned_picture_keeps_its_focal_length_at_the_pixels_of_the_model(tmp_path, ending):
    write(tmp_path / f"a{ending}", {FILM: 28, WIDTH: 4000, HEIGHT: 3000}, orientation=6)  # shown 300 wide, 400 high
    clip = load_clip(tmp_path / f"a{ending}", size=56)
    if ending == ".jpg":  # a HEIC file has no orientation in EXIF, and Pillow's writer none of its own
        assert clip.source_size.tolist() == [[400, 300]]
    K = np.asarray(read_known(EXIF, clip).intrinsics)[0]
    focal = 28 * 500 / np.hypot(36, 24)
    np.testing.assert_allclose(K[[0, 1], [0, 1]], focal / clip.source_scale[0], rtol=1e-6)
    np.testing.assert_allclose(K[:2, 2], np.array(clip.images.shape[2:0:-1]) / 2)  # the middle of the cut frame


def test_pictures_of_a_folder_have_their_own_focal_lengths(tmp_path):
    for number, film in enumerate((26, 26, 52, 77)):
        write(tmp_path / f"{number}.jpg", {FILM: film})
    clip = load_clip(tmp_path, size=56, start=1)
    np.testing.assert_allclose(stated_intrinsics(clip)[:, 0, 0], np.array([26, 52, 77]) * 500 / np.hypot(36, 24))
    assert getattr(focal_stated(clip), "words", None) == "52 mm as on 35 mm film"
    write(tmp_path / "2.jpg", {})
    with pytest.raises(InputError, match=r"2\.jpg states no focal length in its EXIF data; give fx,fy,cx,cy"):
        read_known(EXIF, clip)
    assert focal_stated(clip) is None


def test_a_phone_s_video_states_it_in_its_metadata(tmp_path):
    write_video(tmp_path / "a.mov", "26")
    clip = load_clip(tmp_path / "a.mov", size=56)
    assert stated_intrinsics(clip)[0, 0, 0] == pytest.approx(26 * 80 / np.hypot(36, 24))
    assert stated_intrinsics(clip)[0, :2, 2].tolist() == [32, 24]
    for lie in ("0", "nan", "wide", "1e9", "-26"):
        write_video(tmp_path / "a.mov", lie)
        clip = load_clip(tmp_path / "a.mov", size=56)
        with pytest.raises(InputError, match=r"states a focal length of .*; expected"):
            read_known(EXIF, clip)
        assert focal_stated(clip) is None


LIES = [
    ({FILM: 65535}, "states a focal length of 65535 mm as on 35 mm film, .* expected 40 to 20000"),
    ({FILM: 0, FOCAL: IFDRational(0, 0)}, "states no focal length"),
    ({FILM: 0, FOCAL: IFDRational(1, 0)}, "states no focal length"),
    ({FOCAL: 5.0}, "states a focal length of 5 mm and no size of the sensor"),
    (SENSOR | {UNIT: 77}, "and no size of the sensor"),
    (SENSOR | {FOCAL: 1e9}, "expected 40 to 20000"),
    ({FILM: 26, WIDTH: 4000, HEIGHT: 4000}, "is 400 x 300 and was 4000 x 4000 when it was taken.* so it was cut"),
]


@pytest.mark.parametrize(("tags", "words"), LIES)
def test_what_no_camera_has_is_refused_when_asked_for_and_ignored_else(tmp_path, tags, words, caplog):
    clip = load_clip(write(tmp_path / "a.jpg", tags), size=56)
    assert focal_stated(clip) is None
    assert not caplog.records
    with pytest.raises(InputError, match=words):
        read_known(EXIF, clip)


def test_broken_exif_data_state_nothing_and_warn_of_nothing(tmp_path):
    """Pillow warns of tags that end early, and warnings are errors here."""
    whole = write(tmp_path / "a.jpg", SENSOR).read_bytes()
    start = whole.index(b"Exif")
    for place in range(start + 4, start + 60):
        (tmp_path / "a.jpg").write_bytes(whole[:place] + b"\xff" + whole[place + 1 :])
        with suppress(InputError):
            assert 40 <= picture_focal(tmp_path / "a.jpg").pixels <= 20_000


def test_arrays_and_results_have_no_files():
    with pytest.raises(InputError, match="the clip is not from files"):
        read_known(EXIF, load_clip(np.zeros((2, 56, 56, 3), np.uint8), size=56))
    with pytest.raises(InputError, match="a result has no files"):
        read_known(EXIF, make_room())


def test_the_command_info_says_what_a_clip_is(tmp_path, capsys):
    for number in range(2):
        write(tmp_path / f"{number}.jpg", {FILM: 26})
    assert cli.main(["info", str(tmp_path)]) == 0
    shown = capsys.readouterr().out
    assert "400 x 300 pixels of the first frame, upright" in shown
    assert "26 mm as on 35 mm film, 300.5 pixels; --intrinsics exif takes it" in shown
    assert re.search(r"frames +2\n", shown)
    write(tmp_path / "0.jpg", {FILM: 60000})
    assert cli.main(["info", str(tmp_path)]) == 0
    assert "0.jpg" in capsys.readouterr().out


def test_a_prediction_that_is_far_off_is_said(tmp_path):
    room = make_room()  # 75.6 pixels of the source
    stated = picture_focal(write(tmp_path / "a.jpg", {FILM: 26}))
    said = disagreement(stated._replace(pixels=75.6 / 0.79), room)
    assert said is not None
    assert said.startswith("the predicted focal length, 75.6 pixels across, is -21% off what the camera states; --intr")
    taller = room.intrinsics.copy()
    taller[:, 1, 1] *= 1.3
    unequal = dataclasses.replace(room, intrinsics=taller)
    assert "98.28 pixels down, is +30%" in str(disagreement(stated._replace(pixels=75.6), unequal))
    assert disagreement(stated._replace(pixels=75.6 / 0.81), room) is None


SOURCE_K = [75.6, 75.6, 42.0, 28.0]  # of the room, whose source has twice its 42 x 28 pixels


MATRIX = "75.6 0 42\n0 75.6 28\n0 0 1\n"


@pytest.mark.parametrize("text", [MATRIX, "75.6 75.6 42 28\n", "# fx fy cx cy\n" + "75.6, 75.6, 42, 28\n" * 3])
def test_every_kind_of_file_gives_the_matrix_in_the_pixels_of_the_result(tmp_path, text):
    (tmp_path / "K.txt").write_text(text)
    found = read_intrinsics(str(tmp_path / "K.txt"))
    assert found.shape == (3 if "#" in text else 1, 3, 3)
    np.testing.assert_allclose(at_clip_pixels(found, make_room(), "K"), make_room().intrinsics, rtol=1e-6)
    np.testing.assert_array_equal(found[0], read_intrinsics("75.6,75.6,42,28")[0])


def test_a_crop_moves_the_principal_point(caplog):
    room = make_room(source_offset=np.tile([10.0, 4.0], (3, 1)), source_size=np.tile([64, 104], (3, 1)))
    found = at_clip_pixels(read_intrinsics("75.6,75.6,52,32"), room, "K")
    np.testing.assert_allclose(found, room.intrinsics, rtol=1e-6)
    at_clip_pixels(read_intrinsics("75,75,21,14"), make_room(), "K.txt")
    assert "are the intrinsics those of another size?" in caplog.text


def test_intrinsics_replace_the_predicted_ones_and_change_nothing_else():
    room = make_room()
    found = apply_known(room, read_known(KnownGeometry(intrinsics="60,62,42,28"), room))[0]
    np.testing.assert_allclose(found.intrinsics[:, [0, 1], [0, 1]], np.tile([[30, 31]], (3, 1)), rtol=1e-6)
    np.testing.assert_array_equal(found.camera_from_world, room.camera_from_world)
    np.testing.assert_array_equal(found.depth, room.depth)
    said = "focal length 60 pixels of the source, -20.6% against the prediction (down the picture -18.0%)"
    assert found.known_facts["intrinsics"] == said


def test_values_of_a_file_change_with_the_file(tmp_path):
    known = KnownGeometry(intrinsics=str(tmp_path / "K.txt"))
    (tmp_path / "K.txt").write_text("75 75 42 28")
    first = known_values(known)
    (tmp_path / "K.txt").write_text("80 75 42 28")
    assert first == {"intrinsics": [[[75, 0, 42], [0, 75, 28], [0, 0, 1]]]}
    assert known_values(known)["intrinsics"][0][0] == [80, 0, 42]
    assert known_values(KnownGeometry(intrinsics="source")) == {"intrinsics": "source"}


def test_a_shared_focal_length_is_the_median_in_source_pixels():
    K = make_room().intrinsics.copy()
    K[:, 0, 0], K[:, 1, 1] = [30.0, 40.0, 90.0], [15.0, 20.0, 45.0]  # source pixels: both axes 60, 80, 180
    room = make_room(intrinsics=K, source_scale=np.tile([2.0, 4.0], (3, 1)), source_size=np.tile([112, 84], (3, 1)))
    found = shared_focal(room)
    np.testing.assert_allclose(found[:, 0, 0], 40, rtol=1e-6)
    np.testing.assert_allclose(found[:, 1, 1], 20, rtol=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("151,151,84,56", "the principal point lies at the border .* scale those of another size"),
        ("4,4,42,28", r"expected focal lengths of 8.4 to 4200 pixels"),
        (["75 75 42 28"] * 2, "2 sets of intrinsics; expected 1, or 3"),
    ],
)
def test_intrinsics_that_do_not_fit_are_refused(tmp_path, text, message):
    if isinstance(text, list):  # the lines of a file
        (tmp_path / "K.txt").write_text("\n".join(text))
        text = str(tmp_path / "K.txt")
    with pytest.raises(InputError, match=message):
        apply_known(make_room(), read_known(KnownGeometry(intrinsics=text), make_room()))
