"""Writing a result as files.

In the folder, with a frame's number as its file name:

    reconstruction.npz      everything, for `Reconstruction.load`; written last: where it stands, all files are whole
    report.html             everything to look at on one page, without a network
    preview/sheet.png       the clip at a glance
    preview/card.webp       a frame, its depth and what moves, beside each other
    preview/depth/          inverse depth in colour, one range for the clip
    preview/overlay/        frames with moving objects tinted, every object in a colour of its own
    confidence/             .npy float32
    depth/                  .npy float32, and 16-bit .png with the one scale of the clip that depth/scale.txt gives
    mask/                   255 where dynamic, else 0
    instances/              .png with a palette: 0 where nothing moves, else the object's number, the same in all frames
    trajectory.txt          camera poses, TUM format: timestamp tx ty tz qx qy qz qw, world-from-camera
    intrinsics.txt          fx fy cx cy of every frame, in pixels of depth/ and mask/
    static.ply              the static points of all frames
    frames/                 .ply of all points of a frame
    scene.glb               the clouds and the cameras for a viewer, y up, and a camera that moves as the clip's did

`Saving.only` names the groups of these files that are written; the archive always is.

At the resolution "original" the files of single frames, the clouds and intrinsics.txt are at the size of the source's
pictures; the archive, the sheet, the scene and the tracks' pictures stay at the model's.

With the format "vggt4d" the folder also holds the files that VGGT4D writes, with frames from 0:

    vggt4d/frame_0000.png, frame_0000.npy       picture, depth
    vggt4d/conf_0000.npy, dynamic_mask_0000.png confidence, 255 where dynamic
    vggt4d/pred_intrinsics.txt      3 x 3 matrices, nine numbers a line
    vggt4d/pred_traj.txt            number tx ty tz qw qx qy qz, world-from-camera: qw comes first here

and where points were tracked:

    tracks.npz              positions [S, Q, 2] in pixels of the source, visibility, confidence [S, Q], frames [Q]
    preview/tracks.png      the tracks over some of the frames
    preview/tracks.mp4      the tracks over all frames, where PyAV has an encoder
"""

from __future__ import annotations

import itertools
import logging
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8, UInt16
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from vggtjax.errors import InputError, one_line
from vggtjax.progress import Progress, no_progress
from vggtjax.results import previews, tracks, vggt4d_files
from vggtjax.results.frame import LeastConfidence, ResultFrame, frame_of
from vggtjax.results.glb import glb_bytes, result_scene
from vggtjax.results.gltf_animation import add_camera
from vggtjax.results.point_cloud import PlyWriter, PointCloud, frame_cloud, least_confidence, write_ply
from vggtjax.results.report import REPORT_NAME, RunFacts, report_page
from vggtjax.results.result import Result
from vggtjax.results.saving import GROUPS, Resolution, Saving
from vggtjax.storage.arrays import write_arrays
from vggtjax.storage.markup import webp, write_page
from vggtjax.storage.trajectories import commented, write_trajectory

_PNG_LEVEL = 3  # zlib's; higher ones take several times as long for a few percent
_CARD_WIDTH = 720  # pixels
_WORKERS = 8
_MOST_INVALID = 0.5  # share of a clip's pixels; more are warned about

logger = logging.getLogger(__name__)


def check_saving(result: Result, saving: Saving, pictures: object) -> None:
    """Raise InputError where a result cannot be written in this way."""
    if pictures is not None and saving.resolution != "original":
        raise InputError("pictures are for the resolution 'original'; at the model's size they are not used")
    sizes = {tuple(size) for size in result.source_size.tolist()}
    if saving.format == "vggt4d" and saving.resolution == "original" and len(sizes) > 1:
        raise InputError(f"the source's pictures have {len(sizes)} sizes; the format vggt4d expects one")


def write_files(
    result: Result,
    folder: Path,
    saving: Saving,
    pictures: Iterable[UInt8[np.ndarray, "h w 3"]] | None,
    progress: Progress | None,
    facts: RunFacts | None = None,
) -> int:
    """Write the files that `saving` names, but the archive, into the empty `folder`.

    Returns the number of steps, one of them left for the archive.
    """
    done, total = itertools.count(1), len(result.depth) + 5

    def advance() -> None:
        (progress or no_progress)(next(done), total)

    least = least_confidence(result, saving.confidence_percentile)
    written = _write_frames(result, _frames(result, saving.resolution, pictures), least, saving, folder, advance)
    advance()
    if saving.writes("cameras"):
        _write_cameras(result, written, folder)
    if saving.format == "vggt4d":
        vggt4d_files.write_cameras(folder / "vggt4d", result.world_from_camera, [frame.intrinsics for frame in written])
    if saving.writes("scene"):
        scene = result_scene(result, saving.confidence_percentile)
        (folder / "scene.glb").write_bytes(glb_bytes(scene, partial(add_camera, result)))
    advance()
    if saving.writes("previews"):
        _write_png(folder / "preview/sheet.png", previews.contact_sheet(result))
        (folder / "preview/card.webp").write_bytes(webp(previews.card(result), _CARD_WIDTH))
    if result.track_positions is not None:
        _write_tracks(result, folder, saving)
    advance()
    if saving.writes("report"):
        _write_report(folder, result, facts)
    advance()
    return total


def _write_report(folder: Path, result: Result, facts: RunFacts | None) -> None:
    """Write the report, or log why it cannot be made: the computation is worth more. A full disk raises OSError."""
    try:
        text = report_page(folder, result, facts)
    except Exception as error:  # of any chart or picture; the page is made in memory
        reason = one_line(f"{type(error).__name__}: {error}")
        logger.warning("the result is saved without %s, which could not be made (%s)", REPORT_NAME, reason)
        return
    write_page(folder / REPORT_NAME, text)


def _frames(
    result: Result, resolution: Resolution, pictures: Iterable[UInt8[np.ndarray, "h w 3"]] | None
) -> Iterator[Callable[[], ResultFrame]]:
    """Yield, for each frame, a function that makes it: pictures are read in order, frames are made in parallel."""
    count = len(result.depth)
    shown = iter(pictures) if pictures is not None else itertools.repeat(None, count)
    for number in range(count):
        try:
            picture = next(shown)
        except StopIteration:
            raise InputError(f"there are {number} pictures for {count} frames; expected one for each") from None
        yield partial(frame_of, result, number, resolution, picture=picture)
    if pictures is not None and next(shown, None) is not None:
        raise InputError(f"there are more pictures than the {count} frames; expected one for each")


class _Written(NamedTuple):
    """What the files of the clip need of a written frame."""

    size: tuple[int, int]  # height, width
    intrinsics: Float64[np.ndarray, "3 3"]


def _write_frames(
    result: Result,
    frames: Iterator[Callable[[], ResultFrame]],
    least: LeastConfidence,
    saving: Saving,
    folder: Path,
    advance: Callable[[], None],
) -> list[_Written]:
    """Write the files of single frames, several frames at a time, and the static cloud."""
    write_frame = _frame_writer(result, least, saving, folder)
    written: list[_Written] = []
    workers = min(_WORKERS, os.cpu_count() or 1)
    static_cloud = PlyWriter(folder / "static.ply") if saving.writes("clouds") else nullcontext()
    with static_cloud as static, ThreadPoolExecutor(workers) as pool:
        running: deque[Future[tuple[_Written, PointCloud | None]]] = deque()

        def finish() -> None:
            frame, cloud = running.popleft().result()
            written.append(frame)
            if static is not None and cloud is not None:
                static.add(cloud)
            advance()

        try:
            for number, make in enumerate(frames):
                running.append(pool.submit(write_frame, number, make))
                if len(running) > workers:  # bounds the pictures of the source in memory
                    finish()
            while running:
                finish()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return written


def _frame_writer(
    result: Result, least: LeastConfidence, saving: Saving, folder: Path
) -> Callable[[int, Callable[[], ResultFrame]], tuple[_Written, PointCloud | None]]:
    """Return a function that writes the files of a frame and returns its static points, where clouds are written."""
    has_mask = result.has_mask
    unmade = () if has_mask else GROUPS["masks"]
    names = [name for name in saving.names(tracks=False) if not Path(name).suffix and name not in unmade]
    for name in names:
        (folder / name).mkdir(parents=True)
    if saving.writes("previews"):
        for name in ("depth", *(("overlay",) if has_mask else ())):
            (folder / "preview" / name).mkdir()
    valid, pictured = result.valid_pixels, result.pictured
    invalid = pictured - int(valid.sum())
    if invalid > _MOST_INVALID * pictured:
        logger.warning(
            "%d of %d pixels (%.2f%%) have an invalid depth or confidence and become no points; check the weights and "
            "the inputs", invalid, pictured, 100 * invalid / pictured,
        )  # fmt: skip
    scale = depth_scale(result.depth, valid)
    if saving.writes("depth"):
        head = commented("depth = png / scale, one scale for the clip; 0 in the png: no depth", result.model_note)
        (folder / "depth/scale.txt").write_text(f"{head}\n{scale!r}\n", encoding="utf-8")
    inverse_range = previews.inverse_depth_range(result.depth, valid)
    _ = result.instances  # computed once here, not by each thread

    def write_frame(number: int, make: Callable[[], ResultFrame]) -> tuple[_Written, PointCloud | None]:
        name, frame, cloud = f"{number:06d}", make(), None
        if saving.writes("confidence"):
            np.save(folder / f"confidence/{name}.npy", frame.confidence, allow_pickle=False)
        if saving.writes("depth"):
            np.save(folder / f"depth/{name}.npy", frame.depth, allow_pickle=False)
            encoded = encode_depth(frame.depth, frame.valid, scale)
            _write_png(folder / f"depth/{name}.png", encoded, depth_scale=repr(scale))
        if saving.writes("masks") and has_mask:
            _write_png(folder / f"mask/{name}.png", frame.dynamic_mask.astype(np.uint8) * 255)
            instances = Image.fromarray(frame.instances)
            instances.putpalette(previews.INSTANCE_COLORS.ravel().tolist())
            instances.save(folder / f"instances/{name}.png", compress_level=_PNG_LEVEL)
        if saving.writes("previews"):
            depth = previews.depth_picture(frame.depth, frame.valid, inverse_range)
            _write_png(folder / f"preview/depth/{name}.png", depth)
            if has_mask:
                moving = previews.moving_ids(frame.dynamic_mask, frame.instances)
                _write_png(folder / f"preview/overlay/{name}.png", previews.overlay_picture(frame.image, moving))
        if saving.writes("clouds"):
            pixels = frame.confident(least)
            write_ply(folder / f"frames/{name}.ply", frame_cloud(frame, pixels))
            cloud = frame_cloud(frame, pixels & ~frame.dynamic_mask)
        if saving.format == "vggt4d":
            vggt4d_files.write_frame(folder / "vggt4d", number, frame, mask=has_mask)
        return _Written((frame.depth.shape[0], frame.depth.shape[1]), frame.intrinsics), cloud

    return write_frame


def _write_cameras(result: Result, written: Sequence[_Written], folder: Path) -> None:
    write_trajectory(
        folder / "trajectory.txt", result.world_from_camera, result.file_time_texts, note=result.model_note
    )
    intrinsics, sizes = [frame.intrinsics for frame in written], [frame.size for frame in written]
    write_intrinsics(folder / "intrinsics.txt", intrinsics, sizes, note=result.model_note)


def _write_tracks(result: Result, folder: Path, saving: Saving) -> None:
    scale, offset = result.source_scale[:, None], result.source_offset[:, None]
    arrays = {
        "positions": (result.track_positions * scale + offset).astype(np.float32),
        "visibility": result.track_visibility,
        "confidence": result.track_confidence,
        "frames": result.track_frames,
    }
    write_arrays(folder / "tracks.npz", arrays)
    if saving.writes("previews"):
        _write_png(folder / "preview/tracks.png", tracks.track_strip(result))
        tracks.write_track_video(folder / "preview/tracks.mp4", result)


def depth_scale(depth: Float32[np.ndarray, "S H W"], valid: Bool[np.ndarray, "S H W"]) -> float:
    """Return the factor from the largest valid depth of a clip to 65535, or 1 where no depth is valid."""
    return 65535 / float(depth.max(where=valid, initial=0)) if valid.any() else 1.0


def encode_depth(
    depth: Float32[np.ndarray, "H W"], valid: Bool[np.ndarray, "H W"], scale: float
) -> UInt16[np.ndarray, "H W"]:
    """Return round(depth * scale), at least 1 for a valid depth, and 0 elsewhere."""
    value = np.where(valid, depth, 0).astype(np.float64) * scale
    return np.where(valid, value.round().clip(1, 65535), 0).astype(np.uint16)


def write_intrinsics(
    path: Path, intrinsics: Sequence[Float[np.ndarray, "3 3"]], sizes: Sequence[tuple[int, int]], *, note: str = ""
) -> None:
    """Write one line of fx fy cx cy per frame, in pixels of pictures of these heights and widths."""
    rows = np.stack(intrinsics)[:, [0, 1, 0, 1], [0, 1, 2, 2]]
    height, width = sizes[0]
    of = f"{width} x {height}" if len(set(sizes)) == 1 else "each frame's depth"
    header = commented(f"fx fy cx cy in pixels of {of}", note)
    np.savetxt(path, rows, fmt="%.9g", header=header, comments="", encoding="utf-8")


def _write_png(path: Path, pixels: np.ndarray, **texts: str) -> None:
    information = PngInfo()
    for key, text in texts.items():
        information.add_text(key, text)
    Image.fromarray(pixels).save(path, pnginfo=information, compress_level=_PNG_LEVEL)
