"""True tracks of points through a sequence: in the world, and in its pictures. Does not import jax."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from vggtjax.errors import InputError


@dataclass(frozen=True, eq=False)
class TrueTracks:
    """Points in the world of a sequence's poses, and whether its pictures show them; InputError where none is shown."""

    points: Float64[np.ndarray, "S N 3"]  # finite where visible
    visible: Bool[np.ndarray, "S N"]

    def __post_init__(self) -> None:
        if not self.visible.any():
            raise InputError(f"none of {self.visible.shape[1]} tracks is visible in any of {len(self.visible)} frames")

    def of_frames(self, chosen: Sequence[int]) -> TrueTracks:
        """Return the tracks in some frames, in their order."""
        return TrueTracks(self.points[list(chosen)], self.visible[list(chosen)])


def seen_inside(
    places: Float64[np.ndarray, "S N 2"], visible: Bool[np.ndarray, "S N"], width: int, height: int, source: object
) -> tuple[Bool[np.ndarray, "S N"], tuple[str, ...]]:
    """Return which visible points lie inside their pictures, and a note on the others.

    Raises InputError where none does: the tracks are those of other pictures.
    """
    with np.errstate(invalid="ignore"):
        inside = ((places >= 0) & (places < [width, height])).all(axis=2)
    outside = visible & ~inside
    if outside.any() and not (visible & inside).any():
        frame, track = np.argwhere(outside)[0]
        x, y = places[frame, track]
        raise InputError(
            f"{source} has track {track} visible at ({x:.1f}, {y:.1f}) in frame {frame}, and all its tracks outside "
            f"the pictures of {width} x {height}; expected pixels of these pictures: get the file whole"
        )
    note = f"{int(outside.sum())} of {int(visible.sum())} visible places of tracks lie outside the pictures; left out"
    return visible & inside, (note,) if outside.any() else ()
