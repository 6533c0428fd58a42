"""Lenses that bend straight lines, by COLMAP's camera models, and their pictures as a pinhole sees them.

COLMAP does the mathematics, so that pictures come out as `colmap image_undistorter` writes them: the pinhole has the
lens's focal lengths, and its picture is as large as it can be without a pixel that the lens did not see.
https://colmap.github.io/cameras.html
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Float64, Shaped
from PIL import Image

from vggtjax.clips.captures.numbers import number
from vggtjax.errors import InputError, check_extra

if TYPE_CHECKING:
    import pycolmap

# Numbers of focal lengths and of all parameters; the principal point follows the focal lengths.
MODELS = {
    "SIMPLE_PINHOLE": (1, 3),
    "PINHOLE": (2, 4),
    "SIMPLE_RADIAL": (1, 4),
    "RADIAL": (1, 5),
    "OPENCV": (2, 8),
    "FULL_OPENCV": (2, 12),
    "FOV": (2, 5),
    "OPENCV_FISHEYE": (2, 8),
    "SIMPLE_RADIAL_FISHEYE": (1, 4),
    "RADIAL_FISHEYE": (1, 5),
    "THIN_PRISM_FISHEYE": (2, 12),
}
_FISHEYES = (
    "FOV",
    "OPENCV_FISHEYE",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
)  # without coefficients
_OPENCV = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # in the order of COLMAP's FULL_OPENCV, and of OpenCV
_STEPS = 33  # points along each side of a picture at which a lens is checked
_MOST_PIXELS = 2**28  # of an undistorted picture
_CLOSE = 0.1  # pixels by which a point may miss itself on its way through the lens and back


@dataclass(frozen=True)
class Lens:
    """A camera with distortion: a model of COLMAP, its parameters, and the width and height that they are for."""

    model: str
    params: tuple[float, ...]
    size: tuple[int, int]

    @property
    def is_fisheye(self) -> bool:
        """Whether focal length and principal point alone do not describe the camera, not even roughly."""
        return self.model in _FISHEYES


def lens_of(model: str, params: Iterable[float], size: tuple[int, int], source: Path) -> Lens | None:
    """Return the lens of a camera with one of `MODELS`, None where its picture is that of a pinhole.

    Raises InputError, which names `source`, for coefficients that are not finite.
    """
    values = tuple(float(value) for value in params)
    if not np.isfinite(values).all():
        raise InputError(f"{source} has a lens with parameters that are not finite; expected numbers")
    focal = MODELS[model][0]
    return Lens(model, values, size) if model in _FISHEYES or any(values[focal + 2 :]) else None


def opencv_lens(
    values: Mapping[str, Any],
    intrinsics: Float64[np.ndarray, "3 3"],
    size: tuple[int, int],
    source: Path,
    *,
    model: str = "OPENCV",
) -> Lens | None:
    """Return the lens with OpenCV's coefficients k1 to k6, p1 and p2 in JSON; those that are missing are 0.

    The model is "OPENCV_FISHEYE" with k1 to k4, "FULL_OPENCV" with k4 to k6 in the denominator, or another perspective
    one with k1, k2, k3, p1 and p2: nerfstudio's own k4 is OpenCV's k4 for nobody else. Raises InputError for others.
    """
    fx, fy, cx, cy = (float(intrinsics[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    given = {name: number(values, name, source, 0.0) for name in _OPENCV}
    if model == "OPENCV_FISHEYE":
        unused = [name for name in ("k5", "k6", "p1", "p2") if given[name]]
        coefficients = [given[name] for name in ("k1", "k2", "k3", "k4")]
    else:
        unused = [name for name in ("k4", "k5", "k6") if given[name] and model != "FULL_OPENCV"]
        coefficients = [given[name] for name in _OPENCV]
        model = "FULL_OPENCV" if any(coefficients[4:]) else "OPENCV"
        coefficients = coefficients if any(coefficients[4:]) else coefficients[:4]
    if unused:
        expected = "k1 to k4" if model == "OPENCV_FISHEYE" else "k1, k2, k3, p1 and p2, or the model FULL_OPENCV"
        raise InputError(f"{source} has {unused[0]} = {given[unused[0]]:g} of a lens; expected {expected}")
    return lens_of(model, (fx, fy, cx, cy, *coefficients), size, source)


def check_no_fisheye(lenses: Iterable[Lens | None] | None, source: Path) -> None:
    """Raise InputError for a lens whose intrinsics alone do not describe its pictures."""
    for lens in lenses or ():
        if lens is not None and lens.is_fisheye:
            raise InputError(
                f"{source} has a camera of kind {lens.model}, which is no pinhole: undistort the pictures first "
                "(colmap image_undistorter)"
            )


@dataclass(frozen=True)
class Undistortion:
    """Pictures of a lens, of `stored` (width, height), and what a pinhole sees of them."""

    lens: Lens
    stored: tuple[int, int]

    @cached_property
    def size(self) -> tuple[int, int]:
        """Width and height of the undistorted picture."""
        return self._pinhole.width, self._pinhole.height

    @cached_property
    def intrinsics(self) -> Float64[np.ndarray, "3 3"]:
        """Of the undistorted picture, the centre of whose first pixel is at (0.5, 0.5)."""
        return np.asarray(self._pinhole.calibration_matrix(), np.float64)

    def picture(self, image: Image.Image) -> Image.Image:
        """Return the undistorted picture, bilinear between pixels, of one as it is stored."""
        import pycolmap

        bitmap = pycolmap.Bitmap.from_array(np.ascontiguousarray(image.convert("RGB")))
        made, _ = pycolmap.undistort_image(pycolmap.UndistortCameraOptions(), bitmap, self._camera)
        return Image.fromarray(made.to_array())

    def stored_points(self, points: Float[np.ndarray, "*N 2"]) -> Float64[np.ndarray, "*N 2"]:
        """Return where points (x, y) of the undistorted picture lie in the stored one."""
        flat = np.asarray(points, np.float64).reshape(-1, 2)
        return _through(self._pinhole, self._camera, flat).reshape(np.shape(points))

    def is_stored(self, size: tuple[int, ...]) -> bool:
        """Return whether a map of (width, height) is of the stored picture, not the undistorted one, by its shape."""
        if size == self.size and size != self.stored:
            return False
        return abs(size[0] * self.stored[1] - size[1] * self.stored[0]) <= max(size)

    def nearest(self, values: Shaped[np.ndarray, "h w"]) -> Shaped[np.ndarray, "H W"]:
        """Return a map of the stored picture, such as depth, at the undistorted one: values are never mixed.

        The map may have fewer pixels than the picture, and keeps about as many.
        """
        shares = np.array(values.shape[::-1]) / self.stored
        width, height = np.maximum(1, np.rint(shares * self.size)).astype(int)
        grid = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
        places = self.stored_points(grid * np.array(self.size) / (width, height)) * shares
        x, y = (np.clip(places[..., axis], 0, values.shape[1 - axis] - 1).astype(int) for axis in (0, 1))
        return values[y, x]

    def check(self, source: Path) -> None:
        """Raise InputError, which names `source`, for coefficients that fold the picture or leave no view of it."""
        if self.size[0] * self.size[1] > _MOST_PIXELS:
            raise InputError(
                f"{source} has a lens whose pictures of {self.stored[0]} x {self.stored[1]} become {self.size[0]} x "
                f"{self.size[1]} undistorted; expected at most {_MOST_PIXELS} pixels, so make the pictures smaller"
            )
        points = self.stored_points(_grid(self.size))
        with np.errstate(all="ignore"):
            steps = np.diff(points, axis=1)[:-1], np.diff(points, axis=0)[:, :-1]
            turns = steps[0][..., 0] * steps[1][..., 1] - steps[0][..., 1] * steps[1][..., 0]
        inside = (points > -1).all() and (points < np.array(self.stored) + 1).all()  # False for NaN
        if inside and (turns > 0).all() and (self.lens.is_fisheye or self._comes_back()):
            return
        focal, _ = MODELS[self.lens.model]
        shown = ", ".join(f"{value:g}" for value in self.lens.params[focal + 2 :])
        raise InputError(
            f"{source} has a lens {self.lens.model} with the coefficients {shown}, which fold pictures of "
            f"{self.stored[0]} x {self.stored[1]} onto themselves; expected those of a real lens"
        )

    def _comes_back(self) -> bool:
        points = _grid(self.stored).reshape(-1, 2)
        return bool((np.abs(_through(self._camera, self._camera, points) - points) < _CLOSE).all())  # False for NaN

    @cached_property
    def _camera(self) -> pycolmap.Camera:
        import pycolmap

        width, height = self.lens.size
        camera = pycolmap.Camera(model=self.lens.model, width=width, height=height, params=self.lens.params)
        if self.stored != self.lens.size:
            camera.rescale(*self.stored)
        return camera

    @cached_property
    def _pinhole(self) -> pycolmap.Camera:
        import pycolmap

        return pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), self._camera)


@lru_cache(maxsize=64)
def undistortion(lens: Lens, stored: tuple[int, int], source: Path) -> Undistortion:
    """Return how pictures of a lens are undistorted, for pictures of (width, height).

    Raises InputError for coefficients of no lens, and MissingExtraError without pycolmap.
    """
    check_extra("undoing a lens's distortion (--no-undistort leaves it)", "colmap", "pycolmap")
    made = Undistortion(lens, stored)
    made.check(source)
    return made


def _through(first: pycolmap.Camera, second: pycolmap.Camera, points: Float64[np.ndarray, "N 2"]) -> np.ndarray:
    """Return the pixels in which a camera sees what another sees in its own; NaN for what it does not see."""
    rays = np.asarray(first.cam_from_img(points), np.float64)
    return np.asarray(second.img_from_cam(np.column_stack([rays, np.ones(len(rays))])), np.float64)


def _grid(size: tuple[int, int]) -> Float64[np.ndarray, "n n 2"]:
    """Return points over a picture, from edge to edge."""
    return np.stack(np.meshgrid(*(np.linspace(0, side, _STEPS) for side in size)), axis=-1)
