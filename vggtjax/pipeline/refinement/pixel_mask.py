"""What moves, by the clip's own pixels: they match elsewhere than where a static world is seen (not in the papers)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, UInt8
from PIL import Image

from vggtjax.method.mask import smooth_over_time
from vggtjax.method.matching.matched_mask import TIMES_MEDIAN, motion_pixels
from vggtjax.method.matching.matched_motion import VOTE, voted
from vggtjax.method.matching.matches import frame_pairs
from vggtjax.network.surroundings import own_settings
from vggtjax.pipeline.refinement.cells import Cells, at_scale, cells_of, grey_pictures
from vggtjax.pipeline.refinement.consistent import FEWEST_FRAMES, MOST_FRAMES
from vggtjax.pipeline.refinement.pixel_matches import (
    FEWEST_MATCHED,
    LEAST_WEIGHT,
    PixelMatches,
    Window,
    expected_matches,
    match_pixels,
)
from vggtjax.results.result import AnyResult, Result, mask_is_mined

SOURCE = "mined: matched pixels and Gram similarities"
_PIXELS, _WINDOW = 2, Window(4, 10)  # of a cell; movers can be five cells from where a static world shows them
_SMALLEST_SCALE = 0.2  # cells; smaller differences are no motion
_LARGEST = 8.0  # differences beyond this many scales count as this
_UNKNOWN = 0.25  # quantile of the differences of cells with matches, which the others get: nothing says that they move
_SURE = 0.1  # weight from which a match tells the scale
_LEAST_MOTION = 1e-3  # by matches
_SPECK = 0.25  # of a patch's pixels: smaller regions and holes of the mask are noise
_OFFSET, _FLOOR = 0.25, 0.1  # score = log(difference + offset) + log(Gram + floor)
_TIMES_MEDIAN_ALONE = 4.0  # least motion without matches of the network; the score is then twice as wide


def takes_pixel_mask(result: Result) -> bool:
    """Return whether `mask_by_pixels` mines the mask of a result.

    It does not for fewer than three frames or more than 512, for equal frames, and for a mask that was given, or that
    is refined by depth and cameras.
    """
    if not FEWEST_FRAMES <= len(result.depth) <= MOST_FRAMES or result.saliency is None:
        return False
    is_still = all((image == result.images[0]).all() for image in result.images)
    return mask_is_mined(result) and not result.settings.get("refine_mask") and not is_still


@own_settings()
def mask_by_pixels(result: AnyResult, pictures: Iterable[UInt8[np.ndarray, "h w 3"]] | None = None) -> AnyResult:
    """Return the result with the motion and the dynamic mask that its pixels tell, around its cameras and depth.

    It stays as it is unless `takes_pixel_mask` says so, at least 5 % of the cells have matches, and depth is finite.

    Args:
        result: cameras and depth that agree with the pixels, with the Gram saliency; the motion by matches is read
            where there is one. Its `smooth_frames` are averaged.
        pictures: of the source, in the order of the frames; the result's own images if None.

    Raises ClipError for pictures that are missing, or of another size than the result's.
    """
    from skimage.filters import threshold_otsu

    if result.saliency is None or not takes_pixel_mask(result):
        return result
    cells = cells_of(result)
    grey = grey_pictures(result, pictures, cells.grid)
    motion = pixel_motion(cells, grey, result.saliency, result.motion)
    seen = result.inside_pictures & (result.depth != 0)
    if motion is None or not np.isfinite(motion).all() or not seen.any():
        return result
    motion = np.asarray(smooth_over_time(jnp.asarray(motion[None]), result.settings.get("smooth_frames", 1)))[0]
    pixels = np.stack([_pixels(*each) for each in zip(motion, result.images, strict=True)])
    times_median = _TIMES_MEDIAN_ALONE if result.motion is None else TIMES_MEDIAN
    cut = max(threshold_otsu(pixels[seen]), times_median * np.median(pixels[seen]))
    S, h, w = motion.shape
    patches = seen.reshape(S, h, seen.shape[1] // h, w, -1)
    mask = np.stack([_without_specks(frame, _SPECK * patches[0, 0, :, 0].size) for frame in seen & (pixels >= cut)])
    settings = result.settings | {"masks": SOURCE}
    motion = motion / np.median(motion[patches.any(axis=(2, 4))])
    return dataclasses.replace(result, motion=motion, dynamic_mask=mask & seen, settings=settings)


def pixel_motion(
    cells: Cells,
    grey: UInt8[np.ndarray, "S H W"],
    saliency: Float32[np.ndarray, "S h w"],
    motion: Float32[np.ndarray, "S h w"] | None,
) -> Float32[np.ndarray, "S h w"] | None:
    """Return the motion of every patch, positive: what pixels say, or its geometric mean with what matches say.

    None where pixels say nothing: fewer than 5 % of the cells have matches.

    Pixels say how far they match from where a static world shows them, times the Gram saliency.

    Args:
        cells: of a static world.
        grey: pictures, with 12 pixels a cell.
        saliency: the Gram saliency of every patch, in [0, 1].
        motion: of every patch by the network's matches, over the clip's median; None without them.
    """
    S, (h, w), grid = len(grey), saliency.shape[1:], cells.grid
    expected, warp = expected_matches(cells.depth, cells.cameras, grid)
    found = match_pixels(at_scale(grey, grid, _PIXELS), expected, warp, grid, _WINDOW, cells.shown, strict=True)
    gram = _resized(saliency, grid, Image.Resampling.BILINEAR).reshape(S, -1)
    if (found.weight.sum(axis=1) > LEAST_WEIGHT).mean() < FEWEST_MATCHED:
        return None
    score = np.log(_difference(expected, found) + _OFFSET) + np.log(gram.clip(0, 1) + _FLOOR)
    if motion is not None:
        matched = _resized(motion, grid, Image.Resampling.BILINEAR).reshape(S, -1)
        score = (score - np.median(score) + np.log(np.maximum(matched, _LEAST_MOTION))) / 2
    score = np.asarray(voted(score, found.position, VOTE * found.weight, frame_pairs(S), grid))  # type: ignore[arg-type]
    return _resized(np.exp(score).reshape(S, *grid), (h, w), Image.Resampling.BOX)


def _difference(expected: Float32[np.ndarray, "S M P 2"], found: PixelMatches) -> Float32[np.ndarray, "S P"]:
    """Return how far cells match from where they are expected, over the clip's median; little where unknown."""
    distance, weight = np.linalg.norm(found.position - expected, axis=-1), found.weight
    sure = distance[weight > _SURE]
    scale = max(float(np.median(sure)) if len(sure) else 0.0, _SMALLEST_SCALE)
    total = weight.sum(axis=1)
    mean = np.sum(weight * np.minimum(distance / scale, _LARGEST), axis=1) / np.maximum(total, LEAST_WEIGHT)
    known = total > LEAST_WEIGHT
    return np.where(known, mean, np.quantile(mean[known], _UNKNOWN) if known.any() else 0)


def _without_specks(mask: Bool[np.ndarray, "H W"], least: float) -> Bool[np.ndarray, "H W"]:
    """Return a mask without regions and holes of fewer than `least` pixels."""
    from skimage.morphology import remove_small_holes, remove_small_objects

    most = math.ceil(least) - 1
    return remove_small_objects(remove_small_holes(mask, max_size=most), max_size=most)


@jax.jit
def _pixels(motion: Float[Array, "h w"], image: UInt8[Array, "H W 3"]) -> Float[Array, "H W"]:
    return motion_pixels(motion[None, None], image[None, None] / jnp.float32(255))[0, 0]


def _resized(
    values: Float32[np.ndarray, "S h w"], size: tuple[int, int], how: Image.Resampling
) -> Float32[np.ndarray, "S H W"]:
    pictures = (Image.fromarray(each) for each in values.astype(np.float32))
    return np.stack([np.asarray(picture.resize((size[1], size[0]), how)) for picture in pictures])
