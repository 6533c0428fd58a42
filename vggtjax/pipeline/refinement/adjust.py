"""Robust bundle adjustment of cameras and points over tracks, by pycolmap (Ceres)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float64, Int64

from vggtjax.cameras import Cameras
from vggtjax.pipeline.refinement.tracks import Tracks

_KEPT = 3  # times the scale of the loss: between rounds observations with larger errors are left out, or come back
_STEPS = 100  # of the solver in a round
_TOLERANCE = 1e-6  # relative fall of the cost at which a round ends
_FOCAL_RANGE = 2.0  # a focal length changes at most by this factor


class Adjusted(NamedTuple):
    """Cameras and points after the adjustment; intrinsics are in pixels of the source."""

    cameras: Cameras
    points: Float64[np.ndarray, "N 3"]
    kept: Bool[np.ndarray, " M"]  # observations that agree with them
    agreement: float  # sum over all observations of 1 / (1 + (error / last scale)^2)


def reprojection_errors(
    cameras: Cameras, points: Float64[np.ndarray, "N 3"], tracks: Tracks
) -> Float64[np.ndarray, " M"]:
    """Return the distances of observations from their projected points, in pixels; infinite behind a camera."""
    pose, K = cameras.camera_from_world[tracks.frames], cameras.intrinsics[tracks.frames]
    seen = np.einsum("mij,mj->mi", pose[:, :, :3], points[tracks.points]) + pose[:, :, 3]
    front = seen[:, 2] > 0
    flat = seen[:, :2] / np.where(front, seen[:, 2], 1)[:, None]
    offset = flat * K[:, [0, 1], [0, 1]] + K[:, :2, 2] - tracks.positions
    return np.where(front, np.linalg.norm(offset, axis=1), np.inf)


@contextmanager
def quiet() -> Iterator[None]:
    """Keep pycolmap's log off the terminal, but for errors."""
    import pycolmap

    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level


def adjust(
    cameras: Cameras,
    points: Float64[np.ndarray, "N 3"],
    tracks: Tracks,
    sizes: Int64[np.ndarray, "S 2"],
    scales: Sequence[float],
    *,
    least: int = 3,
    fixed_focal: bool = False,
    on_round: Callable[[], object] = lambda: None,
) -> Adjusted | None:
    """Return adjusted cameras and points; None where the observations are lost, or the focal length runs away.

    Args:
        cameras: where they start; intrinsics in pixels of the source. Frames of one size and one principal point share
            a focal length, which starts at their median, unless `fixed_focal`.
        points: where they start; those behind a camera that sees them may come back later.
        tracks: observations; wrong ones among them are expected.
        sizes: height and width of the pictures.
        scales: of the Cauchy loss, round by round, in pixels of the source.
        least: frames in which a point must be seen.
        fixed_focal: the intrinsics stay as they are.
        on_round: called after each round.
    """
    start, points = cameras, points.copy()
    kept = np.isfinite(errors := reprojection_errors(cameras, points, tracks))
    for scale in scales:
        kept = tracks.long_enough(kept, least)
        if not kept.any():
            return None
        model = _Model(cameras, points, tracks, sizes, kept, fixed_focal)
        model.solve(scale, fixed_focal)
        cameras, points = model.cameras(cameras), model.points(points)
        errors = reprojection_errors(cameras, points, tracks)
        kept = errors < _KEPT * scale
        on_round()
    ratio = cameras.intrinsics[:, 0, 0] / np.median(start.intrinsics[:, 0, 0])
    runs_away = not fixed_focal and ((ratio > _FOCAL_RANGE) | (ratio < 1 / _FOCAL_RANGE)).any()
    if runs_away or not all(np.isfinite(array).all() for array in (*cameras, points)):
        return None
    agreement = float((1 / (1 + (errors / scales[-1]) ** 2)).sum())
    return Adjusted(cameras, points, tracks.long_enough(kept, least), agreement)


def shared_cameras(cameras: Cameras, sizes: Int64[np.ndarray, "S 2"], fixed_focal: bool) -> tuple[list[Any], Any]:
    """Return pycolmap's cameras, numbered from 1, and the place in that list of the camera of each frame."""
    import pycolmap

    K = cameras.intrinsics
    kinds = np.column_stack([sizes, K[:, :2, 2], K[:, [0, 1], [0, 1]] if fixed_focal else K[:, :2, 2]])
    _, first, camera_of = np.unique(kinds, axis=0, return_index=True, return_inverse=True)
    made = []
    for number, frame in enumerate(first):
        fx, fy = np.median(K[camera_of == number][:, [0, 1], [0, 1]], axis=0)
        model, focal = ("PINHOLE", [fx, fy]) if fixed_focal else ("SIMPLE_PINHOLE", [np.sqrt(fx * fy)])
        height, width = sizes[frame].tolist()
        params = [*focal, *K[frame, :2, 2]]
        made.append(pycolmap.Camera(camera_id=number + 1, model=model, width=width, height=height, params=params))
    return made, camera_of


class _Model:
    """A pycolmap reconstruction of the kept observations. Cameras and images are numbered from 1, as frames from 0."""

    def __init__(self, cameras: Cameras, points, tracks: Tracks, sizes, kept, fixed_focal: bool) -> None:
        import pycolmap

        self.model = pycolmap.Reconstruction()
        made, self.camera_of = shared_cameras(cameras, sizes, fixed_focal)
        for camera in made:
            self.model.add_camera_with_trivial_rig(camera)
        elements: dict[int, Any] = {}
        for frame, pose in enumerate(cameras.camera_from_world):
            chosen = np.flatnonzero(kept & (tracks.frames == frame))
            image = pycolmap.Image(
                name=f"{frame}",
                keypoints=tracks.positions[chosen],
                camera_id=int(self.camera_of[frame]) + 1,
                image_id=frame + 1,
            )
            turn = pycolmap.Rotation3d(scipy.spatial.transform.Rotation.from_matrix(pose[:, :3]).as_matrix())
            self.model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(turn, pose[:, 3]))
            for place, point in enumerate(tracks.points[chosen].tolist()):
                elements.setdefault(point, pycolmap.Track()).add_element(frame + 1, place)
        white = np.full(3, 255, np.uint8)
        self.number_of = {self.model.add_point3D(points[i], track, white): i for i, track in elements.items()}

    def solve(self, scale: float, fixed_focal: bool) -> None:
        """Minimise the Cauchy loss of the reprojection errors, at `scale` pixels."""
        import pycolmap

        options = pycolmap.BundleAdjustmentOptions()
        options.print_summary = False
        options.refine_focal_length = not fixed_focal
        options.refine_extra_params = False
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = scale
        options.ceres.solver_options.max_num_iterations = _STEPS
        options.ceres.solver_options.num_threads = 1  # with more, the sums of a run differ from the next run's
        options.ceres.solver_options.function_tolerance = _TOLERANCE
        config = pycolmap.BundleAdjustmentConfig()
        for number in self.model.images:
            config.add_image(number)
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        pycolmap.create_default_bundle_adjuster(options, config, self.model).solve()

    def cameras(self, before: Cameras) -> Cameras:
        """Return the cameras; the principal points are those of before."""
        images = [self.model.images[number] for number in sorted(self.model.images)]
        poses = np.stack([image.cam_from_world().matrix() for image in images])
        intrinsics = before.intrinsics.copy()
        for matrix, number in zip(intrinsics, self.camera_of, strict=True):
            camera = self.model.cameras[int(number) + 1]
            matrix[0, 0], matrix[1, 1] = camera.focal_length_x, camera.focal_length_y
        return Cameras(poses, intrinsics)

    def points(self, before: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
        """Return the points; those that were left out stay where they were."""
        points = before.copy()
        for number, index in self.number_of.items():
            points[index] = self.model.points3D[number].xyz
        return points
