"""COLMAP models byte by byte, and files that are none."""

import struct

import numpy as np
import pytest

from tests.dataset_files import QUARTER_ABOUT_Y, cameras_bin, images_bin, write
from vggtjax.captures.colmap_model import read_views
from vggtjax.errors import InputError

HALF = 0.5**0.5


def model(folder, cameras, images):
    write(folder / "cameras.bin", cameras_bin(cameras))
    write(folder / "images.bin", images_bin(images))
    return folder


IMAGE = (7, (1, 0, 0, 0), (1, 2, 3), 5, "a.png")


@pytest.mark.parametrize(
    ("number", "values", "focal", "distorted"),
    [
        (0, [5, 2, 1], (5, 5), False),  # SIMPLE_PINHOLE
        (1, [5, 6, 2, 1], (5, 6), False),  # PINHOLE
        (2, [5, 2, 1, 0.1], (5, 5), True),  # SIMPLE_RADIAL
        (3, [5, 2, 1, 0, 0], (5, 5), False),  # RADIAL
        (4, [5, 6, 2, 1, 0, 0, 0, 0.1], (5, 6), True),  # OPENCV
        (6, [5, 6, 2, 1] + [0] * 8, (5, 6), False),  # FULL_OPENCV
    ],
)
def test_colmap_models(tmp_path, number, values, focal, distorted):
    """Numbers and parameters of camera models: https://colmap.github.io/cameras.html and its `models.h`."""
    other = (6, 1, 100, 100, [50.0, 50.0, 50.0, 50.0])
    views = read_views(model(tmp_path, [(5, number, 4, 3, values), other], [IMAGE, (*IMAGE[:3], 6, "b/ü.png")]))
    view = views["a.png"]
    assert np.array_equal(view.intrinsics, [[focal[0], 0, 2], [0, focal[1], 1], [0, 0, 1]])
    assert (view.size, view.distorted) == ((4, 3), distorted)
    assert np.array_equal(view.camera_from_world, np.column_stack([np.eye(3), [1, 2, 3]]))
    assert views["b/ü.png"].size == (100, 100)


def test_a_colmap_quaternion_has_its_scalar_first(tmp_path):
    views = read_views(model(tmp_path, [(5, 0, 4, 3, [5, 2, 1])], [(7, (HALF, 0, HALF, 0), (0, 0, 0), 5, "a.png")]))
    assert np.allclose(views["a.png"].camera_from_world[:, :3], QUARTER_ABOUT_Y)


def test_broken_colmap_models_are_refused(tmp_path):
    camera = (5, 0, 4, 3, [5, 2, 1])
    whole = images_bin([IMAGE])
    model(tmp_path, [camera], [IMAGE])
    for cut in (0, 7, 20, 72, 75, 80, 100, len(whole) - 1):
        write(tmp_path / "images.bin", whole[:cut])
        with pytest.raises(InputError, match=r"images\.bin ends"):
            read_views(tmp_path)
    at = whole.index(b"a.png\0") + 6
    for content in (whole[:at] + struct.pack("<Q", 2**63) + whole[at + 8 :], struct.pack("<Q", 2**64 - 1) + whole[8:]):
        write(tmp_path / "images.bin", content)
        with pytest.raises(InputError, match=r"images\.bin ends"):
            read_views(tmp_path)
    for images, message in (
        ([(*IMAGE[:3], 9, "a.png")], "of camera 9; cameras.bin has no such camera"),
        ([(7, (2, 0, 0, 0), *IMAGE[2:])], "a quaternion of length 1"),
        ([(7, (1, 0, 0, 0), (float("nan"), 0, 0), *IMAGE[3:])], "an invalid pose of 'a.png'"),
    ):
        model(tmp_path, [camera], images)
        with pytest.raises(InputError, match=message):
            read_views(tmp_path)
    for broken, message in (
        ((5, 5, 4, 3, [1] * 8), "a camera of kind OPENCV_FISHEYE"),
        ((5, -1, 4, 3, []), "a camera of kind -1"),
        ((5, 0, 0, 3, [5, 2, 1]), "a camera of 0 x 3 pixels"),
        ((5, 0, 4, 3, [0, 2, 1]), "focal lengths above 0"),
        ((5, 0, 4, 3, [5, 2]), r"cameras\.bin ends"),
    ):
        model(tmp_path, [broken], [IMAGE])
        with pytest.raises(InputError, match=message):
            read_views(tmp_path)
    (tmp_path / "cameras.bin").unlink()
    with pytest.raises(InputError, match=r"cannot read .*cameras\.bin"):
        read_views(tmp_path)
