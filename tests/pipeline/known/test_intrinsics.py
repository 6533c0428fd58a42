"""Known intrinsics: their files, and the way to a result's pixels."""

import numpy as np
import pytest

from tests.shared.room import make_room
from vggtjax.errors import InputError
from vggtjax.pipeline.known.apply import apply_known
from vggtjax.pipeline.known.given import read_known
from vggtjax.pipeline.known.intrinsics import at_clip_pixels, known_values, read_intrinsics, shared_focal
from vggtjax.pipeline.known.options import KnownGeometry

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
