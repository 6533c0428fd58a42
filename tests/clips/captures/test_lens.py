"""Lenses with distortion: frames, depth and masks of a capture as a pinhole camera sees them."""

import json
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from tests.clips.captures.folders import write_json
from tests.shared.tiny import tiny_model
from vggtjax import load_clip, reconstruct
from vggtjax.clips.captures.capture import Capture
from vggtjax.clips.captures.lens import Undistortion, lens_of, undistortion
from vggtjax.clips.captures.table import read_capture
from vggtjax.clips.masks import load_masks, masks_at_clip_pixels
from vggtjax.clips.media.sampling import Sampling
from vggtjax.clips.sources import open_source
from vggtjax.errors import ClipError, InputError, MissingExtraError
from vggtjax.pipeline.known.depth_maps import read_depth_maps
from vggtjax.pipeline.known.options import KnownGeometry
from vggtjax.results.exports.write import export_result

pycolmap = pytest.importorskip("pycolmap")

WIDTH, HEIGHT = 320, 240
POINTS = np.stack([*np.meshgrid([-0.6, -0.3, 0.1, 0.5], [-0.4, 0.05, 0.38]), np.ones((3, 4))], axis=-1).reshape(-1, 3)
LENSES = {
    "SIMPLE_RADIAL": [220, 163, 118, -0.12],
    "RADIAL": [220, 163, 118, -0.2, 0.06],
    "OPENCV": [220, 224, 163, 118, -0.2, 0.05, 0.004, -0.003],
    "FULL_OPENCV": [220, 224, 163, 118, -0.2, 0.05, 0.004, -0.003, 0.01, 0.02, -0.01, 0.001],
    "OPENCV_FISHEYE": [170, 172, 163, 118, 0.05, -0.02, 0.004, -0.001],
    "SIMPLE_RADIAL_FISHEYE": [170, 163, 118, 0.05],
    "FOV": [170, 172, 163, 118, 0.9],
}
COEFFICIENTS = {"k1": -0.2, "k2": 0.05, "p1": 0.004, "p2": -0.003, "k3": 0.01}
OPENCV = [220, 224, 163, 118, *COEFFICIENTS.values(), 0, 0, 0]


def opencv_pixels(points):
    """Where OpenCV's formula puts points; written out, to compare COLMAP's with."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = OPENCV[:9]
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    right = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    down = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.column_stack([fx * right + cx, fy * down + cy])


def spots(pixels, size=(WIDTH, HEIGHT)):
    """A picture with a soft white spot around each place; the centre of the first pixel is at (0.5, 0.5).

    They are small: a lens moves the middle of a spot by half its variance times the second derivative.
    """
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    picture = sum(np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 1.2**2)) for u, v in pixels)
    return np.repeat(np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8)[..., None], 3, axis=2)


def centres(image, near):
    """Middles of the spots around places, in pixels."""
    grey = np.asarray(image, float)[..., 0]
    found = []
    for u, v in near:
        left, top = int(u) - 7, int(v) - 7
        row, column = np.asarray(ndimage.center_of_mass(grey[top : top + 15, left : left + 15]), float)
        found.append([column + left + 0.5, row + top + 0.5])
    return np.array(found)


def colmap(folder, model, params, picture, size=(WIDTH, HEIGHT)):
    (folder / "sparse/0").mkdir(parents=True)
    (folder / "images").mkdir()
    Image.fromarray(picture).save(folder / "images/a.png")
    words = " ".join(map(str, params))
    (folder / "sparse/0/cameras.txt").write_text(f"1 {model} {size[0]} {size[1]} {words}\n")
    (folder / "sparse/0/images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n")
    return folder


def nerfstudio(folder, picture, **camera):
    (folder / "images").mkdir(parents=True)
    Image.fromarray(picture).save(folder / "images/a.png")
    pose = np.diag([1.0, -1.0, -1.0, 1.0]).tolist()
    frame = {"file_path": "images/a.png", "transform_matrix": pose}
    values = {"fl_x": 220, "fl_y": 224, "cx": 163, "cy": 118, "w": WIDTH, "h": HEIGHT, **COEFFICIENTS, **camera}
    write_json(folder / "transforms.json", {"camera_model": "OPENCV", **values, "frames": [frame]})
    return folder


def frame_of(folder, **how) -> Any:
    source: Any = open_source(str(folder), **how)
    return source, next(iter(source.frames(Sampling()))).image


@pytest.mark.parametrize("model", LENSES)
def test_points_fall_on_their_spots_within_a_twentieth_of_a_pixel(tmp_path, model):
    camera = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=LENSES[model])
    pixels = camera.img_from_cam(POINTS)
    picture = spots(pixels)
    source, image = frame_of(colmap(tmp_path / "scene", model, LENSES[model], picture))
    K = source.capture.intrinsics[0]
    expected = (POINTS @ K.T)[:, :2]
    inside = ((expected > 10) & (expected < np.array(image.size) - 10)).all(axis=1)
    assert inside.sum() >= 8
    assert np.abs(centres(image, expected[inside]) - expected[inside]).max() < 0.05
    assert np.abs(expected - pixels).max() > 5  # the lens does bend
    made = source.capture.undone[0]
    np.testing.assert_allclose(made.stored_points(expected), pixels, atol=1e-4)
    options, bitmap = pycolmap.UndistortCameraOptions(), pycolmap.Bitmap.from_array(picture)
    theirs, pinhole = pycolmap.undistort_image(options, bitmap, camera)
    np.testing.assert_array_equal(np.asarray(image), theirs.to_array())
    np.testing.assert_array_equal(K, pinhole.calibration_matrix())
    assert image.size == source.capture.sizes[0] == (pinhole.width, pinhole.height)


@pytest.mark.parametrize("smaller", [1, 2])
def test_opencv_s_coefficients_in_nerfstudio_s_file(tmp_path, smaller):
    """Also of a camera for pictures of twice the size that they have."""
    size = (WIDTH // smaller, HEIGHT // smaller)
    picture = spots(opencv_pixels(POINTS) / smaller, size)
    source, image = frame_of(nerfstudio(tmp_path / "scene", picture))
    expected = (POINTS @ source.capture.intrinsics[0].T)[:, :2]
    inside = ((expected > 10) & (expected < np.array(image.size) - 10)).all(axis=1)
    assert np.abs(centres(image, expected[inside]) - expected[inside]).max() < 0.05


def test_masks_and_depth_go_with_the_frames(tmp_path):
    pixels = opencv_pixels(POINTS)
    depth = np.zeros((HEIGHT // 2, WIDTH // 2), np.float32)  # holes, and one value around each point
    for number, (u, v) in enumerate((pixels / 2).astype(int)):
        depth[v - 3 : v + 4, u - 3 : u + 4] = 1 + number
    depth[0, 0] = np.nan
    folder = nerfstudio(tmp_path / "scene", spots(pixels))
    np.save(folder / "depth.npy", 1000 * depth)  # of nerfstudio
    scene = json.loads((folder / "transforms.json").read_text())
    scene["frames"][0]["depth_file_path"] = "depth.npy"
    write_json(folder / "transforms.json", scene)
    capture = frame_of(folder)[0].capture
    made = capture.depth(0)
    assert set(np.unique(made)) == {*range(len(POINTS) + 1)}  # never mixed, and holes stay holes
    shares = np.array(made.shape[::-1]) / capture.sizes[0]
    x, y = ((POINTS @ capture.intrinsics[0].T)[:, :2] * shares).astype(int).T
    np.testing.assert_array_equal(made[y, x], 1 + np.arange(len(POINTS)))

    clip = load_clip(folder, size=224, mode="pad")
    (tmp_path / "maps").mkdir()
    np.save(tmp_path / "maps/a.npy", np.nan_to_num(depth))  # metres, of the pictures as they are stored
    x, y = clip.from_source(0, (POINTS @ capture.intrinsics[0].T)[:, :2]).astype(int).T
    assert read_depth_maps(tmp_path / "maps", clip)[0, y, x].tolist() == list(range(1, 13))
    mask = np.zeros((HEIGHT, WIDTH), bool)
    for u, v in pixels[:6].astype(int):
        mask[v - 5 : v + 6, u - 5 : u + 6] = True
    (tmp_path / "masks").mkdir()
    Image.fromarray(mask).save(tmp_path / "masks/a.png")
    moving = load_masks(tmp_path / "masks", clip)[0]
    np.testing.assert_array_equal(masks_at_clip_pixels(mask[None], clip, clip)[0], moving)
    x, y = clip.from_source(0, (POINTS @ capture.intrinsics[0].T)[:, :2]).astype(int).T
    assert moving[y, x].tolist() == [True] * 6 + [False] * 6
    undistorted = capture.undone[0].nearest(mask)  # of the size of the frames: taken as it is
    assert undistorted.shape == tuple(clip.source_size[0])
    Image.fromarray(undistorted).save(tmp_path / "masks/a.png")
    assert (load_masks(tmp_path / "masks", clip)[0] != moving).mean() < 0.01


def test_without_undistortion_the_coefficients_are_ignored_and_that_is_said(tmp_path, caplog, monkeypatch):
    picture = spots(opencv_pixels(POINTS))
    folder = nerfstudio(tmp_path / "scene", picture)
    source, image = frame_of(folder, undistort=False)
    np.testing.assert_array_equal(np.asarray(image), picture)
    np.testing.assert_array_equal(source.capture.intrinsics[0], [[220, 0, 163], [0, 224, 118], [0, 0, 1]])
    load_clip(source, size=56)
    assert "scene: the coefficients of its lens are ignored" in caplog.text
    caplog.clear()
    load_clip(folder, size=56)
    assert not caplog.records
    fisheye = nerfstudio(tmp_path / "fisheye", picture, is_fisheye=True, p1=0, p2=0)
    with pytest.raises(ClipError, match=r"OPENCV_FISHEYE, which is no pinhole.*; name the folder of the pictures"):
        open_source(str(fisheye), undistort=False)
    undistortion.cache_clear()
    monkeypatch.setattr("vggtjax.errors.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"\(--no-undistort leaves it\) needs the extra 'colmap'"):
        open_source(str(folder))


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        ({"k1": -0.9}, "OPENCV with the coefficients -0.9, .*, which fold pictures of 320 x 240 onto themselves"),
        ({"k1": 1e9}, "which fold pictures"),
        ({"p1": 1e300, "p2": -1e300}, "which fold pictures"),
        ({"k4": 0.1}, "k4 = 0.1 of a lens; expected k1, k2, k3, p1 and p2, or the model FULL_OPENCV"),
        ({"k1": "wide"}, "no numbers under 'k1'"),
        ({"is_fisheye": True}, "p1 = 0.004 of a lens; expected k1 to k4"),
        ({"is_fisheye": True, "p1": 0, "p2": 0, "k1": -3}, "OPENCV_FISHEYE with the coefficients -3, .*, which fold"),
    ],
)
def test_coefficients_of_no_lens_are_refused_in_a_sentence(tmp_path, camera, words):
    folder = nerfstudio(tmp_path / "scene", spots(POINTS[:1, :2]), **camera)
    with pytest.raises(ClipError, match=words):
        open_source(str(folder))


def test_coefficients_that_are_not_finite_are_refused(tmp_path):
    with pytest.raises(InputError, match="not finite"):
        lens_of("RADIAL", [1, 2, 3, float("nan"), 0], (4, 3), tmp_path)


def test_a_fold_outside_of_the_picture_is_none(tmp_path):
    """The radius at which k1 = -0.15 turns back is 1.49, where it sees 0.99; corners are at 0.9."""
    lens = lens_of("SIMPLE_RADIAL", [222, 160, 120, -0.15], (WIDTH, HEIGHT), tmp_path)
    assert lens is not None
    assert isinstance(undistortion(lens, (WIDTH, HEIGHT), tmp_path), Undistortion)


@pytest.mark.filterwarnings("ignore:the field of view")
def test_a_result_has_the_pixels_of_the_undistorted_pictures(tmp_path):
    folder = nerfstudio(tmp_path / "scene", spots(opencv_pixels(POINTS)))
    result = reconstruct(tiny_model(), folder, method="vggt", known=KnownGeometry(intrinsics="source"))
    assert result.settings["undistorted"] == "FULL_OPENCV"
    export_result(result, tmp_path / "out", "nerfstudio", source=open_source(str(folder)))
    back: Capture = read_capture(tmp_path / "out")
    capture = frame_of(folder)[0].capture
    assert back.sizes == capture.sizes
    np.testing.assert_allclose(np.asarray(back.intrinsics), capture.intrinsics, rtol=1e-5)
