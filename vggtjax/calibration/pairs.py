"""In how many pairs of blocks the second pass should suppress keys: tried on scenes, with the masks that users get."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from vggtjax.checkpoint import Model
from vggtjax.config import Gram, Suppress
from vggtjax.errors import InputError
from vggtjax.evaluation.ladder import ClipTruth, LadderRow, ladder
from vggtjax.options import pairs_to_try
from vggtjax.progress import Progress, no_progress


class CameraErrors(NamedTuple):
    """Means over scenes."""

    rotation: float  # degrees
    centres: float  # median depths


class PairsChoice(NamedTuple):
    """Errors of the cameras by the number of pairs; 0 is the first pass."""

    scenes: int  # whose cameras could be scored
    errors: dict[int, CameraErrors]

    @property
    def best(self) -> int:
        """The number of at least 1 whose errors, over those of the first pass, have the smallest sum."""
        first = self.errors[0]

        def loss(pairs: int) -> float:
            return sum(error / max(plain, 1e-12) for error, plain in zip(self.errors[pairs], first, strict=True))

        return min((pairs for pairs in self.errors if pairs), key=lambda pairs: (loss(pairs), pairs))


def choose_pairs(
    model: Model,
    clips: Iterable[ClipTruth],
    pairs: Sequence[int],
    *,
    gram: Gram = "cosine",
    progress: Progress | None = None,
    total: int | None = None,
) -> PairsChoice:
    """Measure the cameras of the second pass, with mined masks, for some numbers of pairs.

    Args:
        model: the network, with the cues that its masks are mined by.
        clips: dynamic clips with exact truth, one at a time.
        pairs: numbers of pairs from 1 to the model's depth.
        gram: similarity of the cues. Keys are zeroed with cosines, and dropped with dot products, as in VGGT4D; masks
            are mined as in 4DVGGT-D with either.
        progress: called with the number of clips done and `total`.

    Raises:
        InputError: an invalid number, or no clip whose cameras can be scored.
    """
    numbers = pairs_to_try(pairs, model.config.depth)
    suppress: Suppress = "drop" if gram == "dot" else "zero"  # as the methods with these cues do
    scenes = []
    for done, clip in enumerate(clips, 1):
        rows = ladder(
            model,
            clip,
            methods=("vggt", "pose-decoupling"),
            masks=["mined"],
            mask_pairs=numbers,
            suppress=[suppress],
            gram=gram,
            batch_size=1,
        )
        errors = {row.mask_pairs or 0: _errors(row) for row in rows}
        scenes.append(np.array([errors[number] for number in (0, *numbers)]))
        (progress or no_progress)(done, total)
    scored = [scene for scene in scenes if np.isfinite(scene).all()]
    if not scored:
        raise InputError(f"none of {len(scenes)} clips has cameras that can be scored; use clips with moving cameras")
    means = np.mean(scored, axis=0)
    return PairsChoice(
        len(scored), {n: CameraErrors(*map(float, row)) for n, row in zip((0, *numbers), means, strict=True)}
    )


def _errors(row: LadderRow) -> CameraErrors:
    """Return the errors of a row; NaN where there is none."""
    rotation, centres = row.rotation_error, row.centre_error_ratio
    return CameraErrors(np.nan if rotation is None else rotation, np.nan if centres is None else centres)
