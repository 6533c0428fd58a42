"""Results of a method that makes no mask, without the one that its steps used."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np

from vggtjax.results.result import Result, makes_no_mask

R = TypeVar("R", bound=Result)


def without_mask(result: R) -> R:
    """Return the result of a method that makes no mask without mask, saliency and motion; others as they are."""
    if not makes_no_mask(result):
        return result
    settings = result.settings | {"masks": f"none: {result.method} makes no mask"}
    nothing = np.zeros(result.dynamic_mask.shape, bool)
    return replace(result, dynamic_mask=nothing, saliency=None, motion=None, settings=settings)
