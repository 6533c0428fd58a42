"""The dynamic mask as objects: regions of each frame, matched to parts at their expected places, joined by motion."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import repeat

import numpy as np
import scipy
from jaxtyping import Bool, Float, Float64, Int, UInt8

from vggtjax.errors import InputError
from vggtjax.results.moving_parts import MovingParts
from vggtjax.storage.arrays import zeros_beside

MOST = 255  # objects: ids fit the palette of a picture
LEAST_SHARE = 5e-4  # of a frame's pixels, for a region to be an object
GAP = 1  # frames for which an object may be lost
_REACH = 2.0  # largest distance of a region from the expected place of its object, in sizes of the object
_NEIGHBOURS = np.ones((3, 3), bool)
_PART = 0.5  # share of a region at the expected place of an object that makes the region a part of that object
_INSIDE = 0.5  # share of the expected place of an object in a region that makes the object a part of that region


@dataclass
class _Object:
    """The state of an object, or of a part of one, after some frames."""

    id: int
    frame: int  # the last one with the object
    centre: Float64[np.ndarray, " 2"]
    velocity: Float64[np.ndarray, " 2"]  # pixels per frame; 0 until the second frame with the object
    pixels: Int[np.ndarray, "N 2"]  # in that frame
    volume: int  # number of pixels in all frames

    def expected(self, frame: int) -> Float64[np.ndarray, " 2"]:
        """Return the expected movement since the last frame with the object."""
        return self.velocity * (frame - self.frame)

    def places(self, frame: int, size: tuple[int, ...]) -> Int[np.ndarray, "N 2"]:
        """Return the expected pixels that are inside the picture."""
        places = np.rint(self.pixels + self.expected(frame)).astype(int)
        return places[((places >= 0) & (places < size)).all(axis=1)]

    def move(self, frame: int, region: Int[np.ndarray, "N 2"]) -> None:
        """Go on as a region of this frame."""
        centre = region.mean(axis=0)
        self.velocity = (centre - self.centre) / (frame - self.frame)
        self.frame, self.centre, self.pixels = frame, centre, region


def find_instances(
    dynamic_mask: Bool[np.ndarray, "S H W"],
    points: Iterable[Float[np.ndarray, "H W 3"]] | None = None,
    *,
    gap: int = GAP,
    least_share: float = LEAST_SHARE,
) -> UInt8[np.ndarray, "S H W"]:
    """Return the ids of moving objects, the same in all frames.

    The connected regions of a frame are matched one to one with the earlier objects, with the least sum of squared
    distances from the expected places (last place plus last velocity), in sizes of the object. A region without a match
    that mostly covers the expected place of a matched object is a part of it; any other region is a new object. A
    region at the expected places of several objects is shared by them: every pixel goes to the nearest. Objects that
    touch and keep their places beside each other are one in the end: a rider and the scooter. Objects are told
    apart if none moves by much more than its own size between two frames.

    Args:
        dynamic_mask: True on dynamic pixels.
        points: of every frame, where its pixels are in the world, NaN where unknown; motion is compared there. None:
            it is compared in the picture.
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
    parts, pixels = MovingParts(), np.moveaxis(np.indices(dynamic_mask.shape[1:]), 0, -1)
    for frame, (mask, places) in enumerate(zip(dynamic_mask, repeat(pixels) if points is None else points)):  # noqa: B905
        known = [owner for owner in objects if frame - owner.frame <= 1 + gap]
        whole = _regions(mask, max(1, least_share * mask.size))
        shares = [_shares(region, known, frame, mask.shape) for region in whole]
        regions = [share for of_region in shares for share in of_region]
        alone = [len(of_region) == 1 for of_region in shares for _ in of_region]
        owners = _matched(known, regions, frame)
        expected = _painted([owner for owner in owners if owner is not None], frame, mask.shape)
        for number, region in enumerate(regions):
            owner = owners[number] or _part_of(region, expected, objects)
            if owner is None:
                objects.append(owner := _Object(len(objects) + 1, frame, region.mean(axis=0), np.zeros(2), region, 0))
            elif owners[number] is not None:
                owner.move(frame, region)
            owner.volume += len(region)
            ids[frame, region[:, 0], region[:, 1]] = owner.id
            if alone[number] and owner.pixels is region:
                parts.see(owner.id, frame, places[region[:, 0], region[:, 1]])
        parts.touch(ids[frame], [{int(ids[frame, *share[0]]) for share in of_region} for of_region in shares])
    return _named(ids, objects, parts.objects(len(objects)))


def _named(ids: Int[np.ndarray, "S H W"], objects: list[_Object], joined: list[int]) -> UInt8[np.ndarray, "S H W"]:
    """Return the ids of joined objects by their volume, the largest first."""
    volumes = np.zeros(len(joined), np.int64)
    np.add.at(volumes, joined[1:], [owner.volume for owner in objects])
    order = [first for first in np.argsort(-volumes, kind="stable").tolist() if volumes[first]][:MOST]
    names = np.zeros(len(joined), np.uint8)
    names[order] = np.arange(1, len(order) + 1)
    named = zeros_beside(ids, np.uint8)
    for frame, of_frame in enumerate(ids):
        named[frame] = names[np.array(joined)[of_frame]]
    return named


def _shares(
    region: Int[np.ndarray, "N 2"], known: list[_Object], frame: int, size: tuple[int, ...]
) -> list[Int[np.ndarray, "N 2"]]:
    """Return a region, divided among the objects that are expected in it if it has room for them beside each other."""
    inside = np.zeros(size, bool)
    inside[region[:, 0], region[:, 1]] = True
    there = [owner for owner in known if inside[tuple(owner.places(frame, size).T)].sum() > _INSIDE * len(owner.pixels)]
    areas = sorted(len(owner.pixels) for owner in there)
    if len(there) < 2 or len(region) - areas[-1] < _INSIDE * sum(areas[:-1]):  # one is hidden by the other
        return [region]
    expected = _painted(there, frame, size)
    nearest = scipy.ndimage.distance_transform_edt(expected == 0, return_distances=False, return_indices=True)
    owners = expected[tuple(nearest)][region[:, 0], region[:, 1]]
    return [region[owners == owner] for owner in np.unique(owners)]


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
        places = owner.places(frame, size)
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
