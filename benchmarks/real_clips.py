"""Filmed clips with ground truth: folders of rgb/, depth/, perhaps mask/, K.txt and world_from_camera.txt."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, UInt16
from PIL import Image

from vggtjax.clips.clip import load_clip
from vggtjax.clips.truth import Truth, at_clip_pixels, intrinsics_at_clip_pixels
from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError
from vggtjax.evaluation.datasets.plain import takes


class Windows(NamedTuple):
    """Windows of a folder's clips, all of one shape: truth [B, S, ...] and the name of each."""

    names: list[str]
    truth: Truth


def is_clip_folder(folder: Path) -> bool:
    """Return whether a folder holds such a clip."""
    return (folder / "rgb").is_dir() and (folder / "world_from_camera.txt").is_file()


def load_windows(folders: list[Path], config: VGGTConfig, frames: int) -> Windows:
    """Load every clip in windows of `frames` consecutive frames, fitted to the model.

    The fewest windows that cover each take, spread evenly, so that the last ones overlap where they must. The truth is
    taken to the prediction's pixels without averaging; depth files are millimetres, 0 where nothing was measured.

    Raises:
        InputError: a take shorter than a window, or files that do not belong together.
    """
    names, truths = [], []
    for folder in folders:
        world_from_camera = _matrices(folder / "world_from_camera.txt", 4)
        for take in takes(world_from_camera[:, :3, 3]):
            if len(take) < frames:
                raise InputError(f"{folder} has a take of {len(take)} frames; choose --frames of at most that")
            for start in window_starts(len(take), frames):
                names.append(f"{folder.name} {take[start]}-{take[start] + frames - 1}")
                truths.append(_window(folder, config, world_from_camera, take[start], frames))
    try:
        return Windows(names, Truth(*(np.stack(arrays) for arrays in zip(*truths, strict=True))))
    except ValueError:
        raise InputError(f"the clips {', '.join(str(folder) for folder in folders)} differ in size") from None


def window_starts(count: int, frames: int) -> list[int]:
    """Return the starts of the fewest windows of `frames` that cover `count` frames, evenly spread."""
    windows = -(-count // frames)
    return np.linspace(0, count - frames, windows).round().astype(int).tolist()


def _window(folder: Path, config: VGGTConfig, world_from_camera: np.ndarray, start: int, frames: int) -> Truth:
    clip = load_clip(folder / "rgb", size=config.image_size, patch=config.patch_size, start=start, max_frames=frames)
    depth = np.stack([read_picture(folder / "depth" / f"{name}.png") for name in clip.frame_names])
    masks = folder / "mask"
    mask = (
        np.stack([read_picture(masks / f"{name}.png") > 0 for name in clip.frame_names])
        if masks.is_dir()
        else depth < 0
    )
    poses = world_from_camera[start : start + frames]
    if len(poses) != len(clip):
        raise InputError(f"{folder} has {len(world_from_camera)} poses; expected one for each image")
    rotation = poses[:, :3, :3].swapaxes(1, 2)
    return Truth(
        images=clip.images,
        depth=at_clip_pixels(clip, depth).astype(np.float32) / 1000,
        dynamic_mask=at_clip_pixels(clip, mask),
        camera_from_world=np.concatenate([rotation, -rotation @ poses[:, :3, 3:]], axis=2),
        intrinsics=intrinsics_at_clip_pixels(clip, _matrices(folder / "K.txt", 3)[0]),
    )


def _matrices(path: Path, size: int) -> Float64[np.ndarray, "N size size"]:
    try:
        return np.loadtxt(path).reshape(-1, size, size)
    except (OSError, ValueError):
        raise InputError(f"{path} cannot be read; expected rows of numbers, {size} x {size} of them a matrix") from None


def read_picture(path: Path) -> UInt16[np.ndarray, "h w"]:
    try:
        with Image.open(path) as image:
            return np.asarray(image).astype(np.uint16)
    except OSError:
        raise InputError(f"{path} cannot be read; expected one image with one channel for each frame") from None
