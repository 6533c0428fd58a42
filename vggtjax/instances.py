"""The dynamic mask as objects: connected components over space and time, with ids that stay. Does not import jax."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, UInt8
from scipy import ndimage

from vggtjax.errors import InputError

MOST = 255  # objects: ids fit the palette of a picture
LEAST_SHARE = 5e-4  # of a frame's pixels that an object must fill in the frame that shows most of it
GAP = 1  # frames for which an object may be lost
_NEIGHBOURS = np.ones((3, 3, 3), bool)  # of a pixel: in its frame, the one before and the one after


def find_instances(
    dynamic_mask: Bool[np.ndarray, "S H W"], *, gap: int = GAP, least_share: float = LEAST_SHARE
) -> UInt8[np.ndarray, "S H W"]:
    """Tell moving objects apart: regions of the mask that touch in space or from one frame to the next are one.

    Objects that touch anywhere in the clip are one; one that moves by more than its own width between two frames is
    two. Sample the clip more densely where that happens.

    Args:
        dynamic_mask: True where the world moves.
        gap: frames for which an object may vanish, and keep its id when it comes back to where it was.
        least_share: of a frame's pixels that an object must fill somewhere; smaller ones are no objects.

    Returns:
        0 where nothing moves (and for what is too small), else the object: 1 fills most pixels of the clip, 255 fewest.

    Raises:
        InputError: a mask that is not bool [S, H, W], or a value out of range.
    """
    if dynamic_mask.ndim != 3 or dynamic_mask.dtype != bool:
        raise InputError(f"dynamic_mask is {dynamic_mask.dtype} {dynamic_mask.shape}; expected bool [S, H, W]")
    if gap < 0 or not 0 <= least_share <= 1:
        raise InputError(f"gap is {gap} and least_share {least_share}; expected at least 0, and 0 to 1")
    linked = dynamic_mask.copy()
    for later in range(1, gap + 1):  # a pixel stays for `gap` frames, and so meets what comes back there
        linked[later:] |= dynamic_mask[:-later]
    labels = np.zeros(linked.shape, np.int32)
    ndimage.label(linked, _NEIGHBOURS, output=labels)
    labels[~dynamic_mask] = 0
    volume, largest = np.zeros((2, labels.max() + 1), np.int64)
    for frame in labels:
        sizes = np.bincount(frame.ravel(), minlength=len(volume))
        volume += sizes
        np.maximum(largest, sizes, out=largest)
    largest[0] = 0
    order = np.argsort(-volume, kind="stable")
    kept = order[largest[order] >= max(1, least_share * dynamic_mask[0].size)][:MOST]
    ids = np.zeros(len(volume), np.uint8)
    ids[kept] = np.arange(1, len(kept) + 1)
    return ids[labels]
