"""A small made-up result with known geometry: a wall, a box that moves in front of it, a camera that swings."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from vggtjax.results.reconstruction import Reconstruction

WALL = 5.0  # z of the wall in the world
BOX = 3.0  # depth of the box in every camera


def make_room(frames: int = 3, height: int = 28, width: int = 42, **changes: Any) -> Reconstruction:
    """Return a result of `frames` frames; `changes` replace fields."""
    time = np.linspace(-1, 1, frames) if frames > 1 else np.zeros(1)
    rotation = Rotation.from_rotvec(0.2 * time[:, None] * [0, 1, 0]).as_matrix().transpose(0, 2, 1)  # camera from world
    centres = np.stack([-time, -0.3 * np.cos(time), -0.2 * time**2], axis=-1)
    focal = 0.9 * width
    intrinsics = np.tile(np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]), (frames, 1, 1))

    y, x = np.mgrid[0:height, 0:width]
    rays = np.stack([(x + 0.5 - width / 2) / focal, (y + 0.5 - height / 2) / focal, np.ones((height, width))], axis=-1)
    slope = np.einsum("hwc,sc->shw", rays, rotation[:, :, 2])  # z in the world of each ray
    depth = (WALL - centres[:, 2, None, None]) / slope
    left = np.linspace(0, width - width // 4, frames).round()[:, None, None]
    mask = (x >= left) & (x < left + width // 4) & (y >= height // 2) & (y < height - 2)
    depth[mask] = BOX

    noise = np.random.default_rng(0).random((frames, height, width))
    images = np.where(mask[..., None], np.array([220, 40, 30]), 60 + 40 * ((x // 4 + y // 4) % 2)[None, ..., None])
    fields: dict[str, Any] = {
        "depth": depth.astype(np.float32),
        "depth_confidence": (1 + noise).astype(np.float32),
        "saliency": mask.reshape(frames, height // 14, 14, width // 14, 14).mean(axis=(2, 4)).astype(np.float32),
        "dynamic_mask": mask,
        "camera_from_world": np.concatenate(
            [rotation, -np.einsum("sij,sj->si", rotation, centres)[..., None]], axis=-1
        ).astype(np.float32),
        "intrinsics": intrinsics.astype(np.float32),
        "images": images.astype(np.uint8),
        "frame_names": tuple(f"../frame {frame}" for frame in range(frames)),
        "timestamps": np.arange(frames) / 24,
        "method": "4dvggt-d",
        "model_name": "tiny",
        "settings": {"mask_pairs": 5, "gram": None},
        "source_size": np.tile([2 * height, 2 * width], (frames, 1)),
        "source_scale": np.full((frames, 2), 2.0),
        "source_offset": np.zeros((frames, 2)),
        "valid_box": np.tile([0, 0, width, height], (frames, 1)),
    }
    return Reconstruction(**(fields | changes))


def textured_room(frames: int = 6, **changes: Any) -> Reconstruction:
    """Return the room at 84 x 56 pixels with waves on its wall and box; `changes` replace fields after painting."""
    room = make_room(frames, 56, 84)
    x, y, _ = np.moveaxis(room.world_points().astype(np.float64), -1, 0)
    waves = np.random.default_rng(3).uniform(1, 6, (6, 2)) * np.array([[1, 1], [1, -1]] * 3)
    grey = sum(np.sin(a * x + b * y + a) for a, b in waves)
    images = np.clip(127 + 25 * grey, 0, 255).astype(np.uint8)[..., None].repeat(3, axis=-1)
    return make_room(frames, 56, 84, **({"images": images} | changes))
