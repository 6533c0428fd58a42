"""Intrinsics by the focal length that a camera wrote into the files of a clip. Does not import jax."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
from jaxtyping import Float64

from vggtjax.clips.captures.frames import CaptureFrames
from vggtjax.clips.clip import Clip
from vggtjax.clips.media.focal import StatedFocal, picture_focal, video_focal
from vggtjax.clips.media.images import ImageFiles
from vggtjax.clips.media.video import VideoFile
from vggtjax.errors import ClipError, InputError
from vggtjax.results.result import Result

# Share of the stated focal length by which a predicted one has to differ to be worth a word. A stated one may be off
# itself: by 2 %, as it is rounded to whole millimetres (26); by 5 to 9 % where the width was meant, or where the
# picture is the part of 16:9 of a sensor of 4:3; by 10 % or so where a stabilised video shows less than the lens sees.
_FAR = 0.2


def stated_intrinsics(clip: Clip) -> Float64[np.ndarray, "F 3 3"]:
    """Return the intrinsics that the files of a clip state, in pixels of the source: one for each picture, or one.

    Pixels are square and the principal point is the middle. Raises InputError for a clip that is not from files, and
    where a file states no focal length or one that no camera has.
    """
    focals, sizes = [focal.pixels for focal in _stated(clip)], clip.source_size[:, ::-1]
    K = np.tile(np.eye(3), (len(focals), 1, 1))
    K[:, 0, 0] = K[:, 1, 1] = focals
    K[:, :2, 2] = sizes[: len(focals)] / 2
    return K


def focal_stated(clip: Clip) -> StatedFocal | None:
    """Return the focal length that the files of a clip state, the middle one of all pictures; None without a word."""
    with suppress(InputError):
        return _middle(clip)
    return None


def focal_in_words(clip: Clip) -> str:
    """Return in words what the files of a clip state of the focal length, or why that cannot be used."""
    try:
        middle = _middle(clip)
    except InputError as error:
        return str(error)
    return f"{middle.words}, {middle.pixels:.4g} pixels; --intrinsics exif takes it"


def disagreement(stated: StatedFocal, result: Result) -> str | None:
    """Return a sentence where the predicted focal length is far from the stated one, else None."""
    by_axis = np.median(result.intrinsics[:, [0, 1], [0, 1]] * result.source_scale, axis=0)  # across, down
    changes = by_axis / stated.pixels - 1
    worst = int(np.abs(changes).argmax())
    if abs(changes[worst]) <= _FAR:
        return None
    axis = ("across", "down")[worst]
    return (
        f"the predicted focal length, {by_axis[worst]:.4g} pixels {axis}, is {changes[worst]:+.0%} off what the camera "
        "states; --intrinsics exif takes the camera's"
    )


def _middle(clip: Clip) -> StatedFocal:
    stated = sorted(_stated(clip))
    return stated[len(stated) // 2]


def _stated(clip: Clip) -> list[StatedFocal]:
    if isinstance(clip.source, CaptureFrames) and clip.source.lenses_undone:
        raise InputError(
            f"intrinsics is 'exif', and the frames of {clip.source.capture.path} are undistorted, so that they are not "
            "those of its files; give 'source', or --no-undistort"
        )
    if isinstance(clip.source, ImageFiles):
        return [picture_focal(clip.source.paths[index]) for index in clip.source.taken(clip.sampling)]
    if isinstance(clip.source, VideoFile):
        height, width = clip.source_size[0].tolist()
        return [video_focal(clip.source.path, clip.source.tags(), (width, height))]
    raise ClipError("intrinsics is 'exif', and the clip is not from files of pictures or a video; give fx,fy,cx,cy")
