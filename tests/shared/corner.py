"""A corner of a room with exact geometry: three textured planes, cameras that look into it, and a result of it."""

from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from vggtjax.cameras import camera_centres, project
from vggtjax.pipeline.refinement.tracks import Tracks
from vggtjax.results.reconstruction import Reconstruction

HEIGHT, WIDTH, SCALE = 144, 192, 3  # of the pictures; the result has a third of these sides
FOCAL = 170.0
_PLANES = ((2, 5.0), (1, 1.2), (0, -1.8))  # wall, floor, side: axis and coordinate in the world
_DEPTH_UNIT = 1.3  # the result's lengths, times those of the room


class Corner(NamedTuple):
    """True cameras, in pixels of the pictures."""

    camera_from_world: np.ndarray
    intrinsics: np.ndarray


def make_corner(frames: int = 6, span: float = 1) -> Corner:
    time = np.linspace(-span, span, frames)
    turns = Rotation.from_euler("yx", np.stack([-12 * time - 4, -6 + 5 * np.cos(2 * time)], axis=1), degrees=True)
    rotation = turns.as_matrix().transpose(0, 2, 1)
    centres = np.stack([1.1 * time, 0.3 * np.sin(3 * time), 0.5 * time**2], axis=1)
    translation = -np.einsum("sij,sj->si", rotation, centres)
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    return Corner(np.concatenate([rotation, translation[:, :, None]], axis=2), np.tile(K, (frames, 1, 1)))


def hits(corner: Corner, frame: int, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points [..., 3] that pixels [..., 2] of a picture show, and their planes."""
    K, pose = corner.intrinsics[frame], corner.camera_from_world[frame]
    rays = (pixels - K[:2, 2]) / K[[0, 1], [0, 1]]
    rays = np.concatenate([rays, np.ones((*pixels.shape[:-1], 1))], axis=-1) @ pose[:, :3]
    centre = camera_centres(pose[None])[0]
    with np.errstate(divide="ignore"):
        lengths = np.stack([(place - centre[axis]) / rays[..., axis] for axis, place in _PLANES], axis=-1)
    lengths[lengths <= 0] = np.inf
    return centre + lengths.min(axis=-1)[..., None] * rays, lengths.argmin(axis=-1)


def grid(height: int, width: int, step: int = 1) -> np.ndarray:
    """Return the centres of cells of `step` pixels."""
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1) * step


def paint(corner: Corner) -> np.ndarray:
    """Return pictures of the corner with blotchy planes."""
    noise = np.random.default_rng(1).standard_normal((3, 400, 400))
    textures = [sum(gaussian_filter(one, sigma, mode="wrap") * sigma for sigma in (1.5, 4)) for one in noise]
    pictures = []
    for frame in range(len(corner.intrinsics)):
        points, planes = hits(corner, frame, grid(HEIGHT, WIDTH))
        grey = np.zeros(planes.shape)
        for number, (axis, _) in enumerate(_PLANES):
            where = np.delete(points, axis, axis=-1)[planes == number].T * 25
            grey[planes == number] = map_coordinates(textures[number], where, order=1, mode="grid-wrap")
        pictures.append(np.repeat(np.clip(128 + 90 * grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2))
    return np.stack(pictures)


def exact_tracks(corner: Corner, wrong: float = 0.0, seed: int = 0) -> Tracks:
    """Return where every frame sees random points of the corner; a share of the places is anywhere else."""
    generator = np.random.default_rng(seed)
    frames = len(corner.intrinsics)
    seen = [hits(corner, frame, generator.uniform(4, [WIDTH - 4, HEIGHT - 4], (40, 2)))[0] for frame in range(frames)]
    points = np.concatenate(seen)
    rows = []
    for frame, (pose, K) in enumerate(zip(corner.camera_from_world, corner.intrinsics, strict=True)):
        x, y, z = project(points, pose, K)
        inside = np.flatnonzero((z > 0) & (x > 1) & (x < WIDTH - 1) & (y > 1) & (y < HEIGHT - 1))
        rows.append(np.column_stack([inside, np.full(len(inside), frame), x[inside], y[inside]]))
    table = np.concatenate(rows)
    table = table[np.bincount(table[:, 0].astype(int))[table[:, 0].astype(int)] >= min(frames, 3)]
    replaced = generator.random(len(table)) < wrong
    table[replaced, 2:] = generator.uniform(0, [WIDTH, HEIGHT], (replaced.sum(), 2))
    return Tracks(np.unique(table[:, 0], return_inverse=True)[1], table[:, 1].astype(int), table[:, 2:])


def corner_result(corner: Corner, *, degrees: float = 4.0, share: float = 0.1, **changes: Any) -> Reconstruction:
    """Return a result whose cameras are wrong by so many degrees, and by a share of path and focal length."""
    generator = np.random.default_rng(3)
    frames = len(corner.intrinsics)
    axes = generator.standard_normal((frames, 3))
    axes[0] = 0
    turns = Rotation.from_rotvec(np.radians(degrees) * axes / np.maximum(np.linalg.norm(axes, axis=1), 1e-9)[:, None])
    rotation = turns.as_matrix() @ corner.camera_from_world[:, :, :3]
    centres = camera_centres(corner.camera_from_world)
    length = np.linalg.norm(np.diff(centres, axis=0), axis=1).sum()
    centres = _DEPTH_UNIT * (centres + share * length / 2 * generator.standard_normal(centres.shape) / np.sqrt(3))
    translation = -np.einsum("sij,sj->si", rotation, centres)
    height, width = HEIGHT // SCALE, WIDTH // SCALE
    K = corner.intrinsics.copy()
    K[:, :2] /= SCALE
    K[:, [0, 1], [0, 1]] *= 1 + share
    depth = np.stack([
        project(hits(corner, frame, grid(height, width, SCALE))[0].reshape(-1, 3), pose, k)[2].reshape(height, width)
        for frame, (pose, k) in enumerate(zip(corner.camera_from_world, corner.intrinsics, strict=True))
    ])  # fmt: skip
    fields: dict[str, Any] = {
        "depth": (_DEPTH_UNIT * depth).astype(np.float32),
        "depth_confidence": np.ones((frames, height, width), np.float32),
        "saliency": None,
        "dynamic_mask": np.zeros((frames, height, width), bool),
        "camera_from_world": np.concatenate([rotation, translation[:, :, None]], axis=2).astype(np.float32),
        "intrinsics": K.astype(np.float32),
        "images": np.zeros((frames, height, width, 3), np.uint8),
        "frame_names": tuple(f"{frame:06d}" for frame in range(frames)),
        "timestamps": None,
        "method": "vggt",
        "model_name": "tiny",
        "settings": {},
        "source_size": np.tile([HEIGHT, WIDTH], (frames, 1)),
        "source_scale": np.full((frames, 2), float(SCALE)),
        "source_offset": np.zeros((frames, 2)),
        "valid_box": np.tile([0, 0, width, height], (frames, 1)),
    }
    return Reconstruction(**(fields | changes))
