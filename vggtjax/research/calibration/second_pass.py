"""How a model's second pass should suppress keys: tried on scenes, with the masks that users get."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple, get_args

import numpy as np

from vggtjax.config import Gram, Suppress, Threshold
from vggtjax.errors import InputError
from vggtjax.network.checkpoint import Model
from vggtjax.options import pairs_to_try
from vggtjax.progress import Progress, no_progress
from vggtjax.research.evaluation.ladder import ClipTruth, LadderRow, ladder


class Setting(NamedTuple):
    """What a model can recommend for its second pass."""

    pairs: int  # of blocks in which keys are suppressed
    threshold: Threshold  # of the saliency


class CameraErrors(NamedTuple):
    """Means over scenes."""

    rotation: float  # degrees
    centres: float  # median depths


class SecondPassChoice(NamedTuple):
    """Errors of the cameras by setting of the second pass."""

    scenes: int  # whose cameras could be scored
    first: CameraErrors  # of the first pass
    errors: dict[Setting, CameraErrors]

    @property
    def best(self) -> Setting:
        """The setting whose errors, over those of the first pass, have the smallest sum; of equal ones, the first."""

        def loss(setting: Setting) -> float:
            errors = zip(self.errors[setting], self.first, strict=True)
            return sum(error / max(plain, 1e-12) for error, plain in errors)

        return min(self.errors, key=loss)


def choose_second_pass(
    model: Model,
    clips: Iterable[ClipTruth],
    pairs: Sequence[int],
    *,
    gram: Gram = "cosine",
    progress: Progress | None = None,
    total: int | None = None,
) -> SecondPassChoice:
    """Measure the cameras of the second pass, with mined masks, for some numbers of pairs and both thresholds.

    Args:
        model: the network, with the cues that its masks are mined by.
        clips: dynamic clips with exact truth, one at a time.
        pairs: numbers of pairs from 1 to the model's depth.
        gram: similarity of the cues. Keys are zeroed with cosines, and dropped with dot products, as in VGGT4D; the
            saliency is that of 4DVGGT-D with either.
        progress: called with the number of clips done and `total`.

    Raises:
        InputError: an invalid number, or no clip whose cameras can be scored.
    """
    numbers = pairs_to_try(pairs, model.config.depth)
    suppress: Suppress = "drop" if gram == "dot" else "zero"  # as the methods with these cues do
    settings = [Setting(number, threshold) for threshold in get_args(Threshold) for number in numbers]
    scenes = []
    for done, clip in enumerate(clips, 1):
        errors: dict[Setting | None, CameraErrors] = {}
        for threshold in get_args(Threshold):
            rows = ladder(
                model,
                clip,
                methods=("vggt", "pose-decoupling"),
                masks=["mined"],
                mask_pairs=numbers,
                suppress=[suppress],
                gram=gram,
                threshold=threshold,
                batch_size=1,
            )
            for row in rows:
                errors[None if row.mask_pairs is None else Setting(row.mask_pairs, threshold)] = _errors(row)
        scenes.append(np.array([errors[setting] for setting in (None, *settings)]))
        (progress or no_progress)(done, total)
    scored = [scene for scene in scenes if np.isfinite(scene).all()]
    if not scored:
        raise InputError(f"none of {len(scenes)} clips has cameras that can be scored; use clips with moving cameras")
    first, *means = (CameraErrors(*map(float, row)) for row in np.mean(scored, axis=0))
    return SecondPassChoice(len(scored), first, dict(zip(settings, means, strict=True)))


def _errors(row: LadderRow) -> CameraErrors:
    """Return the errors of a row; NaN where there is none."""
    rotation, centres = row.rotation_error, row.centre_error_ratio
    return CameraErrors(np.nan if rotation is None else rotation, np.nan if centres is None else centres)
