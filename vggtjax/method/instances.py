"""The dynamic mask as objects: regions of each frame, matched to objects at their expected places."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from jaxtyping import Bool, Float64, Int, UInt8

from vggtjax.errors import InputError
from vggtjax.storage.arrays import zeros_beside

MOST = 255  # objects: ids fit the palette of a picture
LEAST_SHARE = 5e-4  # of a frame's pixels, for a region to be an object
GAP = 1  # frames for which an object may be lost
_REACH = 2.0  # largest distance of a region from the expected place of its object, in sizes of the object
_NEIGHBOURS = np.ones((3, 3), bool)
_PART = 0.5  # share of a region at the expected place of an object that makes the region a part of that object


@dataclass
class _Object:
    """The state of an object after some frames."""

    id: int
    frame: int  # the last one with the object
    centre: Float64[np.ndarray, " 2"]
    velocity: Float64[np.ndarray, " 2"]  # pixels per frame; 0 until the second frame with the object
    pixels: Int[np.ndarray, "N 2"]  # in that frame
    volume: int  # number of pixels in all frames

    def expected(self, frame: int) -> Float64[np.ndarray, " 2"]:
        """Return the expected movement since the last frame with the object."""
        return self.velocity * (frame - self.frame)


def find_instances(
    dynamic_mask: Bool[np.ndarray, "S H W"], *, gap: int = GAP, least_share: float = LEAST_SHARE
) -> UInt8[np.ndarray, "S H W"]:
    """Return the ids of moving objects, the same in all frames.

    The connected regions of a frame are matched one to one with the earlier objects, with the least sum of squared
    distances from the expected places (last place plus last velocity), in sizes of the object. A region without a match
    that mostly covers the expected place of a matched object is a part of it; any other region is a new object. Objects
    that touch are one region, which continues one of them. Objects are told apart if none moves by much more than its
    own size between two frames.

    Args:
        dynamic_mask: True on dynamic pixels.
        gap: frames for which an object may vanish and keep its id.
        least_share: least share of a frame's pixels for a region to be an object.

    Returns:
        0 on static pixels and in small regions, else the id of the object: 1 fills most pixels of the clip, 255 fewest.

    Raises InputError for a mask that is not bool [S, H, W], or a value out of range.
    """
    if dynamic_mask.ndim != 3 or dynamic_mask.dtype != bool:
        raise InputError(f"dynamic_mask is {dynamic_mask.dtype} {dynamic_mask.shape}; expected bool [S, H, W]")
    if gap < 0 or not 0 <= least_share <= 1:
        raise InputError(f"gap is {gap} and least_share {least_share}; expected at least 0, and 0 to 1")
    ids = zeros_beside(dynamic_mask, np.int32)
    objects: list[_Object] = []
    for frame, mask in enumerate(dynamic_mask):
        regions = _regions(mask, max(1, least_share * mask.size))
        known = [owner for owner in objects if frame - owner.frame <= 1 + gap]
        owners = _matched(known, regions, frame)
        expected = _painted([owner for owner in owners if owner is not None], frame, mask.shape)
        for number, region in enumerate(regions):
            owner = owners[number] or _part_of(region, expected, objects)
            if owner is None:
                objects.append(owner := _Object(len(objects) + 1, frame, region.mean(axis=0), np.zeros(2), region, 0))
            elif owners[number] is not None:
                centre = region.mean(axis=0)
                owner.velocity = (centre - owner.centre) / (frame - owner.frame)
                owner.frame, owner.centre, owner.pixels = frame, centre, region
            owner.volume += len(region)
            ids[frame, region[:, 0], region[:, 1]] = owner.id
    names = np.zeros(len(objects) + 1, np.uint8)
    for name, owner in enumerate(sorted(objects, key=lambda owner: -owner.volume)[:MOST], 1):
        names[owner.id] = name
    named = zeros_beside(dynamic_mask, np.uint8)
    for frame, of_frame in enumerate(ids):
        named[frame] = names[of_frame]
    return named


def _regions(mask: Bool[np.ndarray, "H W"], least: float) -> list[Int[np.ndarray, "N 2"]]:
    """Return the pixels (row, column) of each connected region that is large enough, the largest first."""
    labels = np.zeros(mask.shape, np.int32)
    scipy.ndimage.label(mask, _NEIGHBOURS, output=labels)
    places = np.argwhere(labels)
    owner = labels[places[:, 0], places[:, 1]]
    sizes = np.bincount(owner, minlength=int(labels.max()) + 1)[1:]
    order = np.argsort(owner, kind="stable")
    regions = np.split(places[order], np.cumsum(sizes)[:-1]) if len(sizes) else []
    return sorted((region for region in regions if len(region) >= least), key=lambda region: -len(region))


def _matched(known: list[_Object], regions: list[Int[np.ndarray, "N 2"]], frame: int) -> list[_Object | None]:
    """Return the object of each region, None for a region without a match."""
    owners: list[_Object | None] = [None] * len(regions)
    if not known or not regions:
        return owners
    expected = np.stack([owner.centre + owner.expected(frame) for owner in known])
    centres = np.stack([region.mean(axis=0) for region in regions])
    size = np.sqrt([[max(len(owner.pixels), len(region)) for region in regions] for owner in known])
    distance = np.linalg.norm(expected[:, None] - centres[None], axis=2) / size
    cost = np.minimum(distance, _REACH) ** 2  # a region beyond the reach costs as much as no match
    for i, j in zip(*scipy.optimize.linear_sum_assignment(cost), strict=True):
        if distance[i, j] < _REACH:
            owners[j] = known[i]
    return owners


def _painted(owners: list[_Object], frame: int, size: tuple[int, ...]) -> Int[np.ndarray, "H W"]:
    """Return the ids of objects at their expected pixels, 0 elsewhere; small objects lie over large ones."""
    ids = np.zeros(size, np.int32)
    for owner in sorted(owners, key=lambda owner: -len(owner.pixels)):
        places = np.rint(owner.pixels + owner.expected(frame)).astype(int)
        places = places[((places >= 0) & (places < size)).all(axis=1)]
        ids[places[:, 0], places[:, 1]] = owner.id
    return ids


def _part_of(
    region: Int[np.ndarray, "N 2"], expected: Int[np.ndarray, "H W"], objects: list[_Object]
) -> _Object | None:
    """Return the object that is expected at most of a region's pixels."""
    counts = np.bincount(expected[region[:, 0], region[:, 1]])
    counts[0] = 0
    most = int(counts.argmax())
    return objects[most - 1] if counts[most] > _PART * len(region) else None
