"""Writing a result as files.

In the folder, with a frame's number as its file name:

    reconstruction.npz      everything, for `Reconstruction.load`; written last, so its presence says that all is whole
    preview/sheet.png       the clip at a glance
    preview/depth/          inverse depth in colour, one range for the clip
    preview/overlay/        the dynamic region over the frames
    depth/                  .npy float32, and 16-bit .png with the one scale of the clip that depth/scale.txt gives
    mask/                   255 where dynamic, else 0
    trajectory.txt          camera poses, TUM format: timestamp tx ty tz qx qy qz qw, world-from-camera
    intrinsics.txt          fx fy cx cy of every frame, in pixels of the pictures above
    static.ply              what stands still, from all frames
    frames/                 .ply of everything that a frame shows
    scene.glb               the clouds and the cameras for a viewer, y up

and where points were tracked

    tracks.npz              positions [S, Q, 2] in pixels of the source, visibility, confidence [S, Q], frames [Q]
    preview/tracks.png      the tracks over some of the frames
    preview/tracks.mp4      over all of them, where PyAV is installed
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Bool, Float32, UInt16
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from scipy.spatial.transform import Rotation

from vggtjax.files import check_free, staging, writing
from vggtjax.results import archive, point_cloud, previews, tracks
from vggtjax.results.point_cloud import PointCloud
from vggtjax.results.reconstruction import ARCHIVE_NAME, Reconstruction, is_result
from vggtjax.results.scene import build_scene

_NAMES = ("depth", "mask", "preview", "frames", "trajectory.txt", "intrinsics.txt", "static.ply", "scene.glb")
_SOMETIMES = ("tracks.npz",)
_PNG_LEVEL = 3  # zlib's; higher ones take several times as long for a few percent
_WORKERS = 8


def save(
    reconstruction: Reconstruction,
    folder: str | Path,
    *,
    confidence_percentile: float,
    progress: Callable[[int, int], object] | None,
) -> None:
    """Write all files of a result; see `Reconstruction.save`."""
    folder = Path(folder)
    pixels = point_cloud.confident_pixels(reconstruction, confidence_percentile)
    check_folder(folder)
    done, total = itertools.count(1), len(reconstruction.depth) + 4

    def advance() -> None:
        if progress is not None:
            progress(next(done), total)

    with staging(folder) as staged:
        _write_files(reconstruction, pixels, staged, advance)
        _install(staged, folder)


def check_folder(folder: Path) -> None:
    """Make sure that a result can be saved in `folder`, before hours are spent on one.

    Raises OutputError where the folder cannot be made or written, or holds files of our names that are not an earlier
    result.
    """
    check_free(folder, (ARCHIVE_NAME, *_NAMES, *_SOMETIMES), replaced=is_result(folder / ARCHIVE_NAME), what="result")


def _install(staged: Path, folder: Path) -> None:
    """Swap the staged files for those of an earlier result; undo everything if a step fails.

    The archive leaves first and arrives last: whenever it is there, the files around it are its own.
    """
    previous = staged / "previous"
    previous.mkdir()
    old = [name for name in (ARCHIVE_NAME, *_NAMES, *_SOMETIMES) if os.path.lexists(folder / name)]
    moves = [(folder / name, previous / name) for name in old]
    moves += [(staged / name, folder / name) for name in (*_written(staged), ARCHIVE_NAME)]
    done: list[tuple[Path, Path]] = []
    try:
        for source, target in moves:
            source.rename(target)
            done.append((source, target))
    except BaseException:
        for source, target in reversed(done):
            target.rename(source)
        raise


def _written(staged: Path) -> list[str]:
    return [*_NAMES, *(name for name in _SOMETIMES if (staged / name).exists())]


def _write_files(
    reconstruction: Reconstruction, pixels: Bool[np.ndarray, "S H W"], folder: Path, advance: Callable[[], None]
) -> None:
    """Write all files into the empty `folder`; `advance` is called after each frame and each of four large files."""
    write_trajectory(folder / "trajectory.txt", reconstruction)
    write_intrinsics(folder / "intrinsics.txt", reconstruction)
    _write_frames(reconstruction, pixels, folder, advance)
    static = point_cloud.static_cloud(reconstruction, pixels)
    write_ply(folder / "static.ply", static)
    advance()
    build_scene(reconstruction, static, point_cloud.dynamic_clouds(reconstruction, pixels)).export(folder / "scene.glb")
    advance()
    _write_png(folder / "preview/sheet.png", previews.contact_sheet(reconstruction))
    if reconstruction.track_positions is not None:
        _write_tracks(reconstruction, folder)
    advance()
    with writing(folder / ARCHIVE_NAME) as path:
        reconstruction.save_archive(path)
    advance()


def _write_frames(
    reconstruction: Reconstruction, pixels: Bool[np.ndarray, "S H W"], folder: Path, advance: Callable[[], None]
) -> None:
    """Write the files that each frame has of its own, several frames at a time."""
    for name in ("depth", "mask", "preview/depth", "preview/overlay", "frames"):
        (folder / name).mkdir(parents=True)
    valid = point_cloud.valid_pixels(reconstruction)
    scale = depth_scale(reconstruction.depth, valid)
    (folder / "depth/scale.txt").write_text(
        f"# depth = png / scale, one scale for the clip; 0 in the png: no depth\n{scale!r}\n", encoding="utf-8"
    )
    inverse_range = previews.inverse_depth_range(reconstruction.depth, valid)

    def write_frame(frame: int) -> None:
        name = f"{frame:06d}"
        depth, mask = reconstruction.depth[frame], reconstruction.dynamic_mask[frame]
        np.save(folder / f"depth/{name}.npy", depth, allow_pickle=False)
        _write_png(folder / f"depth/{name}.png", encode_depth(depth, valid[frame], scale), depth_scale=repr(scale))
        _write_png(folder / f"mask/{name}.png", mask.astype(np.uint8) * 255)
        _write_png(folder / f"preview/depth/{name}.png", previews.color_depth(depth, valid[frame], inverse_range))
        _write_png(folder / f"preview/overlay/{name}.png", previews.overlay(reconstruction.images[frame], mask))
        write_ply(folder / f"frames/{name}.ply", point_cloud.frame_cloud(reconstruction, frame, pixels[frame]))

    with ThreadPoolExecutor(min(_WORKERS, os.cpu_count() or 1)) as pool:
        try:
            for written in as_completed([pool.submit(write_frame, frame) for frame in range(len(valid))]):
                written.result()
                advance()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _write_tracks(reconstruction: Reconstruction, folder: Path) -> None:
    scale, offset = reconstruction.source_scale[:, None], reconstruction.source_offset[:, None]
    arrays = {
        "positions": (reconstruction.track_positions * scale + offset).astype(np.float32),
        "visibility": reconstruction.track_visibility,
        "confidence": reconstruction.track_confidence,
        "frames": reconstruction.track_frames,
    }
    archive.write_arrays(folder / "tracks.npz", arrays)
    _write_png(folder / "preview/tracks.png", tracks.track_strip(reconstruction))
    tracks.write_track_video(folder / "preview/tracks.mp4", reconstruction)


def depth_scale(depth: Float32[np.ndarray, "S H W"], valid: Bool[np.ndarray, "S H W"]) -> float:
    """Return the factor that takes the largest valid depth of a clip to 65535, 1 where no depth is valid."""
    return 65535 / float(depth[valid].max()) if valid.any() else 1.0


def encode_depth(
    depth: Float32[np.ndarray, "H W"], valid: Bool[np.ndarray, "H W"], scale: float
) -> UInt16[np.ndarray, "H W"]:
    """Return round(depth * scale), at least 1 for a valid depth, and 0 where there is none."""
    value = np.where(valid, depth, 0).astype(np.float64) * scale
    return np.where(valid, value.round().clip(1, 65535), 0).astype(np.uint16)


def write_trajectory(path: Path, reconstruction: Reconstruction) -> None:
    """Write poses in TUM format; without timestamps the frame numbers stand for them."""
    poses = reconstruction.world_from_camera.astype(np.float64)
    times = reconstruction.timestamps if reconstruction.timestamps is not None else np.arange(len(poses))
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)  # xyzw, w at least 0
    header = "timestamp tx ty tz qx qy qz qw (world-from-camera)"
    rows = np.column_stack([times, poses[:, :3, 3], quaternions])
    np.savetxt(path, rows, fmt=["%.6f"] + ["%.9g"] * 7, header=header, encoding="utf-8")


def write_intrinsics(path: Path, reconstruction: Reconstruction) -> None:
    """Write one line of fx fy cx cy per frame."""
    height, width = reconstruction.depth.shape[1:]
    rows = reconstruction.intrinsics[:, [0, 1, 0, 1], [0, 1, 2, 2]]
    header = f"fx fy cx cy in pixels of {width} x {height}"
    np.savetxt(path, rows, fmt="%.9g", header=header, encoding="utf-8")


def write_ply(path: Path, cloud: PointCloud) -> None:
    """Write a cloud as binary PLY with float32 positions and 8-bit colours; it may be empty."""
    trimesh.PointCloud(cloud.points, cloud.colors).export(path, file_type="ply")


def _write_png(path: Path, pixels: np.ndarray, **texts: str) -> None:
    information = PngInfo()
    for key, text in texts.items():
        information.add_text(key, text)
    Image.fromarray(pixels).save(path, pnginfo=information, compress_level=_PNG_LEVEL)
