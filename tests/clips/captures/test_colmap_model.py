import struct

import numpy as np
import pytest

from tests.shared.dataset_files import QUARTER_ABOUT_Y, cameras_bin, images_bin, write
from vggtjax.clips.captures.colmap_model import read_views
from vggtjax.errors import InputError

HALF = 0.5**0.5
IMAGE = (7, (1, 0, 0, 0), (1, 2, 3), 5, "a.png")


@pytest.mark.parametrize(
    ("number", "values", "focal", "distorted"),
    [
        (0, [5, 2, 1], (5, 5), False),  # SIMPLE_PINHOLE
        (1, [5, 6, 2, 1], (5, 6), False),  # PINHOLE
        (2, [5, 2, 1, 0.1], (5, 5), True),  # SIMPLE_RADIAL
        (4, [5, 6, 2, 1, 0, 0, 0, 0.1], (5, 6), True),  # OPENCV
    ],
)
def test_colmap_models(tmp_path, number, values, focal, distorted):
    """Numbers and parameters of camera models: https://colmap.github.io/cameras.html and its `models.h`."""
    turned = (8, (HALF, 0, HALF, 0), (1, 2, 3), 6, "b/ü.png")  # quaternions have the scalar first
    write(tmp_path / "cameras.bin", cameras_bin([(5, number, 4, 3, values), (6, 1, 100, 100, [50.0] * 4)]))
    write(tmp_path / "images.bin", images_bin([IMAGE, turned]))
    views = read_views(tmp_path)
    view = views["a.png"]
    assert np.array_equal(view.intrinsics, [[focal[0], 0, 2], [0, focal[1], 1], [0, 0, 1]])
    assert (view.size, view.lens is not None) == ((4, 3), distorted)
    assert np.array_equal(view.camera_from_world, np.column_stack([np.eye(3), [1, 2, 3]]))
    assert views["b/ü.png"].size == (100, 100)
    assert np.allclose(views["b/ü.png"].camera_from_world[:, :3], QUARTER_ABOUT_Y)


CAMERA = (5, 0, 4, 3, [5, 2, 1])
LONG = struct.pack("<Q", 2**64 - 1)  # says that it has so many images


@pytest.mark.parametrize(
    ("camera", "images", "message"),
    [
        (CAMERA, LONG + images_bin([IMAGE])[8:], r"images\.bin ends"),
        (CAMERA, images_bin([(*IMAGE[:3], 9, "a.png")]), "of camera 9; cameras.bin has no such camera"),
        (CAMERA, images_bin([(7, (2, 0, 0, 0), *IMAGE[2:])]), "a quaternion of length 1"),
        (CAMERA, images_bin([(7, (1, 0, 0, 0), (float("nan"), 0, 0), *IMAGE[3:])]), "an invalid pose of 'a.png'"),
        ((5, 16, 4, 3, [1] * 8), images_bin([IMAGE]), "a camera of kind 16; expected one of SIMPLE_PINHOLE"),
    ],
)
def test_broken_colmap_models_are_refused(tmp_path, camera, images, message):
    write(tmp_path / "cameras.bin", cameras_bin([camera]))
    write(tmp_path / "images.bin", images)
    with pytest.raises(InputError, match=message):
        read_views(tmp_path)
