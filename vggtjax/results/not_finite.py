"""Values of a result that are not finite: how many, of which arrays, in one warning."""

from __future__ import annotations

import warnings

import numpy as np

from vggtjax.errors import one_line
from vggtjax.results.result import Result

_ARRAYS = {
    "depth": ("pixels", "which become no points"),
    "depth_confidence": ("pixels", "which become no points"),
    "saliency": ("patches", "which count as still"),
}
_MOST_LETTERS = 80  # of the clip's name


class NotFiniteWarning(UserWarning):
    """A part of what the network predicted is NaN or infinite."""


def warn_of_not_finite(result: Result) -> None:
    """Give one NotFiniteWarning if depth, confidence or saliency holds NaN or infinity; padding does not count."""
    found = [text for name in _ARRAYS if (text := _lost(result, name))]
    if found:
        clip = one_line(str(result.settings.get("clip", "the clip")), _MOST_LETTERS)
        warnings.warn(
            f"{clip}: not finite are {', and '.join(found)}; look at these frames, or compute in float32 "
            "(precision 'highest')",
            NotFiniteWarning,
            stacklevel=3,
        )


def _lost(result: Result, name: str) -> str:
    """Return how much of an array is not finite, in words; nothing if all is finite."""
    values = getattr(result, name)
    if values is None or np.isfinite(values).all():
        return ""
    counted = result.inside_pictures if name != "saliency" else np.ones(values.shape, bool)
    lost = ~np.isfinite(values) & counted
    frames, share = int(lost.any(axis=(1, 2)).sum()), lost.sum() / counted.sum()
    if not frames:
        return ""
    places, what_follows = _ARRAYS[name]
    return f"{name} at {share:.2%} of the {places}, in {frames} of {len(values)} frames ({what_follows})"
