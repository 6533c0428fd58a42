"""Another start of the adjustment: cameras by COLMAP's global mapper, from the matches alone."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from vggtjax.cameras import Cameras, camera_centres
from vggtjax.pipeline.refinement.adjust import shared_cameras
from vggtjax.pipeline.refinement.matches import Pair
from vggtjax.pipeline.refinement.tracks import Tracks


class Matched(NamedTuple):
    """Features of the frames, and the verified matches of pairs of frames."""

    positions: Sequence[Float64[np.ndarray, "N 2"]]  # pixels of the source
    matches: Mapping[Pair, Int64[np.ndarray, "K 2"]]  # indices of features


def map_globally(
    cameras: Cameras, sizes: Int64[np.ndarray, "S 2"], matched: Matched, fixed_focal: bool
) -> Cameras | None:
    """Return cameras by rotation averaging and global positioning (GLOMAP); None unless all frames are placed.

    Of `cameras` only the intrinsics are read: the focal lengths are where those of the mapper start.
    """
    import pycolmap

    shared, camera_of = shared_cameras(cameras, sizes, fixed_focal)
    for camera in shared:
        camera.has_prior_focal_length = True
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = 0
    options.num_threads = 1  # with more, the sums of a run differ from the next run's
    options.mapper.bundle_adjustment.refine_focal_length = not fixed_focal
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "matches.db")
        _write(path, shared, camera_of, matched)
        models = pycolmap.global_mapping(path, folder, folder, options)
    complete = [model for model in models.values() if model.num_reg_images() == len(camera_of)]
    if not complete:
        return None
    model = complete[0]
    images = sorted(model.images.values(), key=lambda image: int(image.name))
    intrinsics = cameras.intrinsics.copy()
    for matrix, image in zip(intrinsics, images, strict=True):
        matrix[0, 0], matrix[1, 1] = image.camera.focal_length_x, image.camera.focal_length_y
    return Cameras(np.stack([image.cam_from_world().matrix() for image in images]), intrinsics)


def nearest_to_rays(cameras: Cameras, tracks: Tracks) -> Float64[np.ndarray, "N 3"]:
    """Return the point of each track with the smallest sum of squared distances from its rays."""
    pose, K = cameras.camera_from_world, cameras.intrinsics[tracks.frames]
    flat = (tracks.positions - K[:, :2, 2]) / K[:, [0, 1], [0, 1]]
    rays = np.einsum("mji,mj->mi", pose[tracks.frames][:, :, :3], np.column_stack([flat, np.ones(len(flat))]))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]  # removes the part along a ray
    centres = camera_centres(pose)[tracks.frames]
    left, right = np.zeros((tracks.number, 3, 3)), np.zeros((tracks.number, 3))
    np.add.at(left, tracks.points, across)
    np.add.at(right, tracks.points, np.einsum("mij,mj->mi", across, centres))
    return np.einsum("nij,nj->ni", np.linalg.pinv(left), right)


def _write(path: str, cameras, camera_of, matched: Matched) -> None:
    """Write a database of COLMAP. Images are numbered from 1, as frames from 0."""
    import pycolmap

    verifying = pycolmap.TwoViewGeometryOptions()
    verifying.ransac.random_seed = 0
    with pycolmap.Database.open(path) as database:
        rigs = []
        for camera in cameras:
            camera.camera_id = database.write_camera(camera)
            rig = pycolmap.Rig()
            rig.add_ref_sensor(camera.sensor_id)
            rigs.append(database.write_rig(rig))
        for frame, positions in enumerate(matched.positions):
            image = pycolmap.Image(name=f"{frame}", camera_id=cameras[camera_of[frame]].camera_id)
            image.image_id = database.write_image(image)
            placed = pycolmap.Frame()
            placed.rig_id = rigs[camera_of[frame]]
            placed.add_data_id(image.data_id)
            database.write_frame(placed)
            database.write_keypoints(image.image_id, positions.astype(np.float32))
        for (a, b), pairs in matched.matches.items():
            pairs = pairs.astype(np.uint32)
            first, second = cameras[camera_of[a]], cameras[camera_of[b]]
            geometry = pycolmap.estimate_two_view_geometry(
                first, matched.positions[a], second, matched.positions[b], pairs, verifying
            )
            database.write_matches(a + 1, b + 1, pairs)
            database.write_two_view_geometry(a + 1, b + 1, geometry)
