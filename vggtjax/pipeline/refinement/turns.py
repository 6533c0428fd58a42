"""Cameras that turn as features of the pictures do: a start that does not depend on the network's cameras.

SIFT features of neighbouring frames are matched, and the rotation is taken with which most of their rays meet (RANSAC).
Between neighbours a camera turns more than it travels, so that most of a static scene agrees with one rotation.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import scipy
from jaxtyping import Bool, Float32, Float64, UInt8

from vggtjax.cameras import camera_centres
from vggtjax.pipeline.refinement.cells import Cells

_FEWEST = 12  # rays that meet, from which a rotation counts
_LEAST_SHARE = 0.3  # of the matches
_FEWEST_NEIGHBOURS = 0.5  # share of the neighbours whose rotation must be known
_SAMPLES = 512  # of RANSAC, of two rays each
_NEAR = np.radians(1.5)  # rays that meet
_ALIKE = np.radians(3.0)  # largest difference of cameras that turn as predicted
_CONTRAST = 0.005  # least of a feature
_RATIO = 0.8  # of the distances to the nearest and the second nearest descriptor

PictureRays = tuple[Float64[np.ndarray, "N 3"], Float32[np.ndarray, "N 128"]]  # rays of length 1, and their descriptors


def turned_by_features(
    cells: Cells, grey: UInt8[np.ndarray, "S H W"], on_frame: Callable[[], object] = lambda: None
) -> Float64[np.ndarray, "S 3 4"] | None:
    """Return cameras (camera from world) with the predicted centres that turn as features of the pictures do.

    A frame whose rotation from the one before is not known turns as predicted. None where fewer than half are known,
    or where all cameras turn as predicted, to 3 degrees.

    Args:
        cells: predicted cameras, and where nothing moves.
        grey: pictures of the frames, with one whole number of pixels a cell.
        on_frame: called for each frame.
    """
    before = cells.cameras.camera_from_world.astype(np.float64)
    steps = before[1:, :, :3] @ before[:-1, :, :3].transpose(0, 2, 1)
    features = (_features(cells, frame, picture, on_frame) for frame, picture in enumerate(grey))
    generator, known = np.random.default_rng(0), 0
    for step, (first, second) in enumerate(pairwise(features)):
        found = _rotation(first, second, generator)
        if found is not None:
            steps[step], known = found, known + 1
    if known < _FEWEST_NEIGHBOURS * len(steps):
        return None
    poses = before.copy()
    for frame, step in enumerate(steps, start=1):
        poses[frame, :, :3] = step @ poses[frame - 1, :, :3]
    turned = scipy.spatial.transform.Rotation.from_matrix(poses[:, :, :3] @ before[:, :, :3].transpose(0, 2, 1))
    if turned.magnitude().max() < _ALIKE:
        return None
    poses[:, :, 3] = -np.einsum("sij,sj->si", poses[:, :, :3], camera_centres(before))
    return poses


def _features(
    cells: Cells, frame: int, picture: UInt8[np.ndarray, "H W"], on_frame: Callable[[], object]
) -> PictureRays:
    """Return SIFT features of a picture on cells that do not move."""
    on_frame()
    from skimage.feature import SIFT

    sift = SIFT(upsampling=1, c_dog=_CONTRAST)
    try:
        with np.errstate(all="ignore"):
            sift.detect_and_extract(picture / np.float32(255))
    except (RuntimeError, ValueError):  # there is no feature, or one whose orientation is not a number
        return np.zeros((0, 3)), np.zeros((0, 128), np.float32)
    rows, columns = cells.grid
    place = (np.asarray(sift.keypoints)[:, ::-1] + 0.5) * columns / picture.shape[1]  # x, y in cells
    column, row = np.minimum(place.astype(int), [columns - 1, rows - 1]).T
    static = cells.is_static[frame, row * columns + column] > 0.5
    K = cells.cameras.intrinsics[frame].astype(np.float64)
    rays = np.column_stack([(place - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(len(place))])[static]
    return rays / np.linalg.norm(rays, axis=1, keepdims=True), np.asarray(sift.descriptors, np.float32)[static]


def _rotation(
    first: PictureRays, second: PictureRays, generator: np.random.Generator
) -> Float64[np.ndarray, "3 3"] | None:
    """Return the rotation from the first camera to the second with which most rays meet; None for too few."""
    from skimage.feature import match_descriptors

    if min(len(first[0]), len(second[0])) < _FEWEST:
        return None
    matches = match_descriptors(first[1], second[1], cross_check=True, max_ratio=_RATIO)
    if len(matches) < _FEWEST:
        return None
    own, other = first[0][matches[:, 0]], second[0][matches[:, 1]]
    pair = generator.integers(len(own), size=(_SAMPLES, 2))
    tried = _aligned(own[pair], other[pair])
    meet = np.einsum("kij,nj,ni->kn", tried, own, other) > np.cos(_NEAR)
    best: Bool[np.ndarray, " N"] = meet[meet.sum(axis=1).argmax()]
    if best.sum() < max(_FEWEST, _LEAST_SHARE * len(own)):
        return None
    return _aligned(own[best][None], other[best][None])[0]


def _aligned(own: Float64[np.ndarray, "K N 3"], other: Float64[np.ndarray, "K N 3"]) -> Float64[np.ndarray, "K 3 3"]:
    """Return the rotations that bring rays closest to others (Kabsch)."""
    left, _, right = np.linalg.svd(np.einsum("kni,knj->kij", other, own))
    left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
    return left @ right
