"""A clip: frames of the model's size with the way back to the pixels they came from. Does not import jax."""

from __future__ import annotations

import logging
import os
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from jaxtyping import Float, Float32, Float64, Int, UInt8

from vggtjax.clips.captures.frames import CaptureFrames
from vggtjax.clips.media.images import ImageFiles
from vggtjax.clips.media.sampling import Sampling, Source
from vggtjax.clips.preprocessing import Fit, Fitter, Framing, Mode
from vggtjax.clips.shots import ShotWatch, warn_of_dark
from vggtjax.clips.sources import ClipSource, open_source
from vggtjax.clips.still import same_picture
from vggtjax.config import VGGTConfig
from vggtjax.errors import ClipError, InputError, one_line
from vggtjax.progress import Progress, no_progress

logger = logging.getLogger(__name__)

_MOST_WORKERS = 4
_LARGE_CUT = 0.1  # share of a picture's pixels; larger cuts are warned about
MOST_BYTES = 2**34  # of the images of one clip; over 5000 frames of 518 x 518
Rendered = UInt8[np.ndarray, "H W 3"] | Float32[np.ndarray, "H W 3"]


@dataclass(frozen=True, eq=False)
class Clip:
    """Frames as the model takes them, and where each of their pixels lies in the source.

    Continuous coordinates are (x, y) with pixel edges at whole numbers, so the centre of the first pixel is at
    (0.5, 0.5); source pixels are those of the upright frame, after EXIF orientation or rotation of the video.
    """

    images: Float32[np.ndarray, "S H W 3"] = field(repr=False)  # RGB in [0, 1]
    frame_names: list[str] = field(repr=False)  # stem of the image file, or 000000-style index in the source
    timestamps: Float64[np.ndarray, " S"] | None = field(repr=False)  # seconds from the source's first frame; or None
    mode: Mode
    size: int
    patch: int
    source_size: Int[np.ndarray, "S 2"] = field(repr=False)  # (height, width)
    source_scale: Float64[np.ndarray, "S 2"] = field(repr=False)  # source = scale * clip + offset, in (x, y)
    source_offset: Float64[np.ndarray, "S 2"] = field(repr=False)
    valid_box: Int[np.ndarray, "S 4"] = field(repr=False)  # (left, top, right, bottom) of clip pixels not padding
    source: Source = field(repr=False)
    sampling: Sampling

    def __len__(self) -> int:
        return len(self.images)

    @property
    def is_still(self) -> bool:
        """Whether all frames are one picture, up to the noise of a video's codec: nothing can be seen to move."""
        return all(same_picture(image, self.images[0]) for image in self.images[1:])

    def to_source(self, frame: int, points: Float[np.ndarray, "... 2"]) -> Float64[np.ndarray, "... 2"]:
        """Return the source coordinates (x, y) of points given in clip coordinates of `frame`."""
        return _points(points) * self.source_scale[frame] + self.source_offset[frame]

    def from_source(self, frame: int, points: Float[np.ndarray, "... 2"]) -> Float64[np.ndarray, "... 2"]:
        """Return the clip coordinates (x, y) of points given in source coordinates of `frame`."""
        return (_points(points) - self.source_offset[frame]) / self.source_scale[frame]

    def pictures(self) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """Yield the upright pictures that the frames were made of, read from the source again.

        Raises ClipError where the source cannot be read any more, or gives other frames than before.
        """
        number = -1
        for number, frame in enumerate(self.source.frames(self.sampling)):
            if number >= len(self) or frame.name != self.frame_names[number]:
                raise ClipError(f"the source of the clip gives frame {frame.name}, not as before; load the clip anew")
            yield np.asarray(frame.image)
        if number + 1 < len(self):
            raise ClipError(f"the source of the clip gives {number + 1} of {len(self)} frames; load the clip anew")

    def refit(self, size: int, patch: int, mode: Mode | None = None) -> Clip:
        """Return the same frames, read from the source again, at another size, patch or mode.

        Raises InputError for a value out of range, as in `load_clip`, and ClipError where the source cannot be read any
        more, or gives other frames than before.
        """
        clip = read_clip(self.source, self.sampling, Fitter(mode or self.mode, size, patch))
        if clip.frame_names != self.frame_names or not np.array_equal(clip.source_size, self.source_size):
            raise ClipError("the source of the clip gives other frames than before; load the clip anew")
        return clip


class Configured(Protocol):
    """What has a configuration: the model that `load_model` returned."""

    @property
    def config(self) -> VGGTConfig: ...


def load_clip(
    source: ClipSource,
    *,
    model: Configured | None = None,
    mode: Mode | None = None,
    size: int | None = None,
    patch: int | None = None,
    fps: float | None = None,
    stride: int = 1,
    start: int = 0,
    max_frames: int | None = None,
    skip: str | None = None,
    progress: Progress | None = None,
) -> Clip:
    """Load frames and bring them to the model's size the way VGGT was trained (Pillow's bicubic, 8 bits).

    `load_clip("clip.mp4", model=model)` loads as `reconstruct(model, "clip.mp4")` does.

    Args:
        source: a folder of images, a pattern such as "frames/*.png", an image or video file, a list of image paths,
            a list of PIL images or of arrays [H, W, 3], or one array [S, H, W, 3] (uint8, uint16, or floating point
            in [0, 1]; 8 bits are kept, but floating point stays as it is where it is not resized), or a capture of an
            app (see `vggtjax.clips.captures.find_capture`), whose frames are undistorted where it has coefficients of
            its lens; or what `open_source` returned.
            Files of folders and patterns are taken in natural order (frame_2 before frame_10), hidden files and files
            that are not images left out; a list keeps its order.
        model: what `load_model` returned: its own size and patch size are taken, but `size` wins where it is given.
        mode: "crop" makes frames `size` wide and cuts the height to at most `size`; "pad" makes the long side `size`
            and pads the frame with white to a square; "fit" makes the long side `size` and keeps every pixel. By
            default as the model was trained; "crop" without a model.
        size: width, or side of the square; a multiple of `patch`; the model's own, or VGGT-1B's 518 without a model.
        patch: side of the model's patches; sides of frames are multiples of it. Left out with a model; else 14.
        fps: frames to take per second of a video, by presentation time: of every 1 / fps seconds the first frame.
        stride: take every stride-th frame; not together with `fps`.
        start: index of the first frame to take, counted in frames of the source, for video too.
        max_frames: take at most this many frames; a video is not decoded further.
        skip: frames to leave out, such as "0-2,17", counted as for `start`.
        progress: called after each frame with the number of frames done and of all frames, None if unknown.

    Returns:
        The clip. Frames of different sizes are padded with white to the largest, as VGGT does, with a warning logged.

    Raises:
        InputError: an argument out of range, something else than a model, or another patch size than the model's.
        ClipError: no frames, a source that is missing or cannot be read, or a frame that cannot be used.
    """
    fitter, sampling = _fitter(model, mode, size, patch), Sampling(start, stride, fps, max_frames, skip)
    return read_clip(open_source(source), sampling, fitter, progress)


def _fitter(model: Configured | None, mode: Mode | None, size: int | None, patch: int | None) -> Fitter:
    if model is None:
        return Fitter(
            mode or Fitter.mode, Fitter.size if size is None else size, Fitter.patch if patch is None else patch
        )
    config = getattr(model, "config", None)
    if not isinstance(config, VGGTConfig):
        raise InputError(f"model is {one_line(repr(model), 50)}; expected what load_model returned")
    if patch not in (None, config.patch_size):
        raise InputError(f"patch is {patch}; leave it out, as the model's patch size is {config.patch_size}")
    return Framing(mode, size).fitter(config)


def read_clip(
    source: Source,
    sampling: Sampling,
    fitter: Fitter,
    progress: Progress | None = None,
    *,
    warn: bool = True,
    is_part: bool = False,
) -> Clip:
    """Read the frames of a source that `sampling` takes, fitted to the model; `load_clip` says more.

    With `warn` what the source leaves out, large crops and padding are logged, and, unless the frames are a part of a
    clip, those that are no part of its scene.
    """
    if warn:
        warn_of_left_out(source)
    total = source.total(sampling)
    watch = ShotWatch(sampling)
    names: list[str] = []
    times: list[float] = []
    pixels: list[Rendered] = []
    fits: list[Fit] = []
    rendering: deque[Future[Rendered]] = deque()
    workers = min(os.cpu_count() or 1, _MOST_WORKERS)
    with ThreadPoolExecutor(workers) as pool:  # Pillow resizes without holding the interpreter
        for frame in watch.over(source.frames(sampling)):
            fit = fitter.fit(*frame.image.size, frame.name)
            width, height = fit.frame_size
            if 12 * width * height * (len(fits) + 1) > MOST_BYTES:  # 3 channels of 4 bytes
                raise ClipError(
                    f"more than {len(fits)} frames of {width} x {height} exceed the {MOST_BYTES >> 30} GiB of a clip; "
                    f"take fewer with max_frames, stride or fps, or a smaller size"
                )
            names.append(frame.name)
            if frame.time is not None:
                times.append(frame.time)
            fits.append(fit)
            rendering.append(pool.submit(fit.render, frame))
            if len(rendering) > workers:  # bounds the frames of the source's size in memory
                pixels.append(rendering.popleft().result())
            (progress or no_progress)(len(fits), total)
        pixels.extend(render.result() for render in rendering)
    most = max(fits, key=lambda fit: fit.cut_share)
    if warn and most.cut_share > _LARGE_CUT:
        size = "frames of {} x {} pixels lose".format(*most.source_size)
        cut = 100 * most.cut_share
        logger.warning("%s %.0f %% of their pixels above and below; mode 'pad' (--preprocess pad) keeps all", size, cut)
    images, fits = _joined(pixels, fits, warn=warn)
    boxes = np.array([fit.box for fit in fits], np.int64)
    if warn and not is_part:
        watch.warn()
        if not isinstance(source, ImageFiles):  # which says it of each
            warn_of_dark(images, boxes)
    return Clip(
        images=images,
        frame_names=names,
        timestamps=np.array(times, np.float64) if times else None,
        mode=fitter.mode,
        size=fitter.size,
        patch=fitter.patch,
        source_size=np.array([fit.source_size[::-1] for fit in fits], np.int64),
        source_scale=np.array([fit.scale for fit in fits], np.float64),
        source_offset=np.array([fit.offset for fit in fits], np.float64),
        valid_box=boxes,
        source=source,
        sampling=sampling,
    )


def warn_of_left_out(source: Source) -> None:
    """Log what a folder or capture has and its clip leaves out, and files that may be no frames."""
    if isinstance(source, ImageFiles):
        for note in source.notes:
            logger.warning("%s: %s", source.paths[0].parent, note)
    if isinstance(source, CaptureFrames):
        for note in source.capture.left_out:
            logger.warning("%s: %s", source.capture.path, note)
        if source.capture.lenses is not None:
            logger.warning("%s: the coefficients of its lens are ignored; its frames are not undistorted", source.name)


def _joined(pixels: list[Rendered], fits: list[Fit], *, warn: bool) -> tuple[Float32[np.ndarray, "S H W 3"], list[Fit]]:
    """Return the frames in one array, smaller frames centred on white, and their new fits."""
    sizes = {fit.frame_size for fit in fits}
    width, height = max(size[0] for size in sizes), max(size[1] for size in sizes)
    if warn and len(sizes) > 1:
        listed = ", ".join(f"{size[0]} x {size[1]}" for size in sorted(sizes)[:4])
        logger.warning("frames have different sizes (%s); they are padded with white to %d x %d", listed, width, height)
    images = np.ones((len(pixels), height, width, 3), np.float32)
    widened = [fit.widen(width, height) for fit in fits]
    for image, frame, before, after in zip(images, pixels, fits, widened, strict=True):
        left, top = after.box[0] - before.box[0], after.box[1] - before.box[1]
        values = frame if frame.dtype == np.float32 else frame / np.float32(255)
        image[top : top + frame.shape[0], left : left + frame.shape[1]] = values
    return images, widened


def _points(points: Float[np.ndarray, "... 2"]) -> Float64[np.ndarray, "... 2"]:
    values = np.asarray(points, np.float64)
    if values.ndim == 0 or values.shape[-1] != 2:
        raise InputError(f"points have shape {values.shape}; expected (x, y) along the last axis")
    return values
