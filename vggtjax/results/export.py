"""Writing a result as files.

In the folder, with a frame's number as its file name:

    reconstruction.npz      everything, for `Reconstruction.load`; written last, so its presence says that all is whole
    preview/sheet.png       the clip at a glance
    preview/depth/          inverse depth in colour, one range for the clip
    preview/overlay/        what moves over the frames, every object in a colour of its own
    confidence/             .npy float32
    depth/                  .npy float32, and 16-bit .png with the one scale of the clip that depth/scale.txt gives
    mask/                   255 where dynamic, else 0
    instances/              .png with a palette: 0 where nothing moves, else the object's number, the same in all frames
    trajectory.txt          camera poses, TUM format: timestamp tx ty tz qx qy qz qw, world-from-camera
    intrinsics.txt          fx fy cx cy of every frame, in pixels of depth/ and mask/
    static.ply              what stands still, from all frames
    frames/                 .ply of everything that a frame shows
    scene.glb               the clouds and the cameras for a viewer, y up

At the resolution "original" everything that is a file per frame, the clouds and intrinsics.txt are at the size of the
source's pictures; the archive, the sheet and the tracks' pictures stay at the model's.

With the format "vggt4d" there is also a folder as VGGT4D writes it, with frames from 0:

    vggt4d/frame_0000.png, frame_0000.npy       picture, depth
    vggt4d/conf_0000.npy, dynamic_mask_0000.png confidence, 255 where dynamic
    vggt4d/pred_intrinsics.txt      3 x 3 matrices, nine numbers a line
    vggt4d/pred_traj.txt            as trajectory.txt, with frame numbers for times. Theirs has qw before qx qy qz.

and where points were tracked

    tracks.npz              positions [S, Q, 2] in pixels of the source, visibility, confidence [S, Q], frames [Q]
    preview/tracks.png      the tracks over some of the frames
    preview/tracks.mp4      over all of them, where PyAV is installed
"""

from __future__ import annotations

import itertools
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Float32, Float64, UInt8, UInt16
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from vggtjax.errors import InputError
from vggtjax.progress import Progress
from vggtjax.results import foreign, point_cloud, previews, tracks
from vggtjax.results.frame import Frame, frame_of, valid_pixels
from vggtjax.results.glb import build_scene
from vggtjax.results.ply import PlyWriter, write_ply
from vggtjax.results.point_cloud import PointCloud
from vggtjax.results.reconstruction import ARCHIVE_NAME, Reconstruction, is_result, saved_files
from vggtjax.results.saving import Format, Resolution, Saving
from vggtjax.storage import arrays as archive
from vggtjax.storage.trajectories import write_trajectory
from vggtjax.storage.writing import check_free, staging, writing

_NAMES = (
    "confidence", "depth", "mask", "instances", "preview", "frames",
    "trajectory.txt", "intrinsics.txt", "static.ply", "scene.glb",
)  # fmt: skip
_PNG_LEVEL = 3  # zlib's; higher ones take several times as long for a few percent
_WORKERS = 8


def save(
    reconstruction: Reconstruction,
    folder: str | Path,
    saving: Saving,
    *,
    pictures: Iterable[UInt8[np.ndarray, "h w 3"]] | None,
    progress: Progress | None,
) -> None:
    """Write all files of a result; see `Reconstruction.save`."""
    folder = Path(folder)
    least = point_cloud.least_confidence(reconstruction, saving.confidence_percentile)
    if pictures is not None and saving.resolution != "original":
        raise InputError("pictures are for the resolution 'original'; at the model's size they are not used")
    sizes = {tuple(size) for size in reconstruction.source_size.tolist()}
    if saving.format == "vggt4d" and saving.resolution == "original" and len(sizes) > 1:
        raise InputError(f"the source's pictures have {len(sizes)} sizes; the format vggt4d expects one")
    optional = optional_files(tracks=reconstruction.track_positions is not None, format=saving.format)
    check_folder(folder, optional)
    done, total = itertools.count(1), len(reconstruction.depth) + 4

    def advance() -> None:
        if progress is not None:
            progress(next(done), total)

    with staging(folder) as staged:
        frames = _frames(reconstruction, saving.resolution, pictures)
        _write_files(reconstruction, frames, least, saving.format, staged, advance)
        with writing(staged / ARCHIVE_NAME) as path:
            reconstruction.save_archive(path, files=optional)
        advance()
        _install(staged, folder, optional)


def optional_files(*, tracks: bool, format: Format) -> tuple[str, ...]:
    """Return the files that this result has and others do not."""
    return tuple(name for name, is_written in (("tracks.npz", tracks), ("vggt4d", format == "vggt4d")) if is_written)


def _frames(
    reconstruction: Reconstruction, resolution: Resolution, pictures: Iterable[UInt8[np.ndarray, "h w 3"]] | None
) -> Iterator[Callable[[], Frame]]:
    """Yield, for each frame, what makes it: pictures are read in order, the rest can be done side by side."""
    count = len(reconstruction.depth)
    shown = iter(pictures) if pictures is not None and resolution == "original" else itertools.repeat(None, count)
    for number in range(count):
        try:
            picture = next(shown)
        except StopIteration:
            raise InputError(f"there are {number} pictures for {count} frames; expected one for each") from None
        yield partial(frame_of, reconstruction, number, resolution, picture=picture)
    if pictures is not None and next(shown, None) is not None:
        raise InputError(f"there are more pictures than the {count} frames; expected one for each")


def check_folder(folder: Path, optional: Sequence[str] = ()) -> None:
    """Make sure that a result can be saved in `folder`, before hours are spent on one.

    Args:
        folder: need not be there.
        optional: what `optional_files` says of the result.

    Raises OutputError where the folder cannot be made or written, or holds files of our names that are not part of an
    earlier result.
    """
    archive_path = folder / ARCHIVE_NAME
    check_free(folder, (ARCHIVE_NAME, *_NAMES), replaced=is_result(archive_path), what="result")
    strange = [name for name in optional if name not in saved_files(archive_path)]
    check_free(folder, strange, replaced=False, what="result")


def _install(staged: Path, folder: Path, optional: Sequence[str]) -> None:
    """Swap the staged files for those of an earlier result; undo everything if a step fails.

    The archive leaves first and arrives last: whenever it is there, the files around it are its own.
    """
    previous = staged / "previous"
    previous.mkdir()
    earlier = (ARCHIVE_NAME, *_NAMES, *saved_files(folder / ARCHIVE_NAME))
    old = [name for name in earlier if os.path.lexists(folder / name)]
    moves = [(folder / name, previous / name) for name in old]
    moves += [(staged / name, folder / name) for name in (*_NAMES, *optional, ARCHIVE_NAME)]
    done: list[tuple[Path, Path]] = []
    try:
        for source, target in moves:
            source.rename(target)
            done.append((source, target))
    except BaseException:
        for source, target in reversed(done):
            target.rename(source)
        raise


def _write_files(
    reconstruction: Reconstruction,
    frames: Iterator[Callable[[], Frame]],
    least_confidence: float,
    format: Format,
    folder: Path,
    advance: Callable[[], None],
) -> None:
    """Write all files but the archive into the empty `folder`; `advance` is called after each frame and large file."""
    times, poses = reconstruction.timestamps, reconstruction.world_from_camera
    times = np.arange(len(poses), dtype=np.float64) if times is None else times  # frame numbers stand for them
    write_trajectory(folder / "trajectory.txt", poses, times)
    written = _write_frames(reconstruction, frames, least_confidence, format, folder, advance)
    advance()
    intrinsics = [frame.intrinsics for frame in written]
    write_intrinsics(folder / "intrinsics.txt", intrinsics, [frame.size for frame in written])
    if format == "vggt4d":
        foreign.write_cameras(folder / "vggt4d", poses, intrinsics)
    _build_scene(reconstruction, least_confidence).export(folder / "scene.glb")
    advance()
    _write_png(folder / "preview/sheet.png", previews.contact_sheet(reconstruction))
    if reconstruction.track_positions is not None:
        _write_tracks(reconstruction, folder)
    advance()


def _build_scene(reconstruction: Reconstruction, least_confidence: float) -> trimesh.Scene:
    """Return the scene for viewers, at the model's size: they show no more points than that."""
    static, dynamic = [], []
    for number in range(len(reconstruction.depth)):
        frame = frame_of(reconstruction, number)
        sure = frame.surer_than(least_confidence)
        static.append(point_cloud.frame_cloud(frame, sure & ~frame.dynamic_mask))
        dynamic.append(point_cloud.frame_cloud(frame, sure & frame.dynamic_mask))
    return build_scene(reconstruction, point_cloud.joined(static), dynamic)


class _Written(NamedTuple):
    """What is left of a frame once its files are written."""

    size: tuple[int, int]  # height, width
    intrinsics: Float64[np.ndarray, "3 3"]


def _write_frames(
    reconstruction: Reconstruction,
    frames: Iterator[Callable[[], Frame]],
    least_confidence: float,
    format: Format,
    folder: Path,
    advance: Callable[[], None],
) -> list[_Written]:
    """Write the files that each frame has of its own, several frames at a time, and the cloud of what stands still."""
    for name in ("confidence", "depth", "mask", "instances", "preview/depth", "preview/overlay", "frames"):
        (folder / name).mkdir(parents=True)
    if format == "vggt4d":
        (folder / "vggt4d").mkdir()
    valid = valid_pixels(reconstruction)
    scale = depth_scale(reconstruction.depth, valid)
    (folder / "depth/scale.txt").write_text(
        f"# depth = png / scale, one scale for the clip; 0 in the png: no depth\n{scale!r}\n", encoding="utf-8"
    )
    inverse_range = previews.inverse_depth_range(reconstruction.depth, valid)

    def write_frame(number: int, make: Callable[[], Frame]) -> tuple[_Written, PointCloud]:
        name, frame = f"{number:06d}", make()
        valid, pixels = frame.valid, frame.surer_than(least_confidence)
        np.save(folder / f"confidence/{name}.npy", frame.confidence, allow_pickle=False)
        np.save(folder / f"depth/{name}.npy", frame.depth, allow_pickle=False)
        _write_png(folder / f"depth/{name}.png", encode_depth(frame.depth, valid, scale), depth_scale=repr(scale))
        _write_png(folder / f"mask/{name}.png", frame.dynamic_mask.astype(np.uint8) * 255)
        _write_palette(folder / f"instances/{name}.png", frame.instances)
        _write_png(folder / f"preview/depth/{name}.png", previews.color_depth(frame.depth, valid, inverse_range))
        moving = previews.moving_ids(frame.dynamic_mask, frame.instances)
        _write_png(folder / f"preview/overlay/{name}.png", previews.overlay(frame.image, moving))
        write_ply(folder / f"frames/{name}.ply", [point_cloud.frame_cloud(frame, pixels)])
        if format == "vggt4d":
            foreign.write_frame(folder / "vggt4d", number, frame)
        size = (frame.depth.shape[0], frame.depth.shape[1])
        return _Written(size, frame.intrinsics), point_cloud.frame_cloud(frame, pixels & ~frame.dynamic_mask)

    _ = reconstruction.instances  # computed here, once, and not by each thread
    written: list[_Written] = []
    workers = min(_WORKERS, os.cpu_count() or 1)
    with PlyWriter(folder / "static.ply") as static, ThreadPoolExecutor(workers) as pool:
        running: deque[Future[tuple[_Written, PointCloud]]] = deque()

        def finish() -> None:
            frame, cloud = running.popleft().result()
            written.append(frame)
            static.add(cloud)
            advance()

        try:
            for number, make in enumerate(frames):
                running.append(pool.submit(write_frame, number, make))
                if len(running) > workers:  # no more than so many pictures of the source at a time
                    finish()
            while running:
                finish()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return written


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


def write_intrinsics(
    path: Path, intrinsics: Sequence[Float[np.ndarray, "3 3"]], sizes: Sequence[tuple[int, int]]
) -> None:
    """Write one line of fx fy cx cy per frame; `sizes` are height and width of the pictures that they are pixels of."""
    rows = np.stack(intrinsics)[:, [0, 1, 0, 1], [0, 1, 2, 2]]
    height, width = sizes[0]
    of = f"{width} x {height}" if len(set(sizes)) == 1 else "each frame's depth"
    np.savetxt(path, rows, fmt="%.9g", header=f"fx fy cx cy in pixels of {of}", encoding="utf-8")


def _write_palette(path: Path, ids: UInt8[np.ndarray, "H W"]) -> None:
    picture = Image.fromarray(ids)
    picture.putpalette(previews.INSTANCE_COLORS.ravel().tolist())
    picture.save(path, compress_level=_PNG_LEVEL)


def _write_png(path: Path, pixels: np.ndarray, **texts: str) -> None:
    information = PngInfo()
    for key, text in texts.items():
        information.add_text(key, text)
    Image.fromarray(pixels).save(path, pnginfo=information, compress_level=_PNG_LEVEL)
