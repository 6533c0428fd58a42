"""The methods, as a table: how motion is mined, which pass gives what (4DVGGT-D, table 2). Does not import jax."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vggtjax.config import Gram, Suppress
from vggtjax.errors import InputError

Pass = Literal["first", "second"]
Threshold = Literal["otsu", "multi-otsu"]
MethodName = Literal["vggt", "vggt4d", "pose-decoupling", "hard-replacement", "4dvggt-d"]


@dataclass(frozen=True)
class Method:
    """Where a method takes its depth (and confidence) and its cameras from, and how it masks the second pass.

    `clusters` is the number of groups of patch features within which the saliency is averaged before it is cut at the
    `threshold`; 0 for none. `refine` says whether the mask is refined at the end, by the method's depth and cameras.
    """

    depth: Literal["first", "second", "replaced", "fused"]
    extrinsics: Pass
    intrinsics: Pass
    gram: Gram = "cosine"
    suppress: Suppress = "zero"
    clusters: int = 0
    threshold: Threshold = "otsu"
    refine: bool = False

    @property
    def needs_second_pass(self) -> bool:
        return {self.depth, self.extrinsics, self.intrinsics} != {"first"}

    def second_outputs(self, align_scale: bool = False) -> tuple[str, ...]:
        """What is read of the second pass: scales are aligned by depth, and otherwise its cameras may be enough."""
        return ("camera", "depth") if self.depth != "first" or align_scale else ("camera",)


METHODS: dict[str, Method] = {
    "vggt": Method("first", "first", "first"),
    "vggt4d": Method("first", "second", "first", "dot", "drop", clusters=64, threshold="multi-otsu", refine=True),
    "pose-decoupling": Method("second", "second", "second"),
    "hard-replacement": Method("replaced", "second", "second"),
    "4dvggt-d": Method("fused", "second", "second"),
}

LADDER = ("vggt", "pose-decoupling", "hard-replacement", "4dvggt-d")  # what one run of both passes gives


def check_smooth_frames(frames: int) -> None:
    """Raise InputError for a number of frames to average over that has no middle."""
    if type(frames) is not int or frames < 1 or frames % 2 == 0:
        raise InputError(f"smooth_frames is {frames!r}; expected an odd number of frames, such as 3")


def check_mask_pairs(pairs: object) -> None:
    """Raise InputError for a number that is no number of pairs; what is traced is not looked at."""
    if isinstance(pairs, int | float) and (pairs != int(pairs) or pairs < 0):
        raise InputError(f"mask_pairs is {pairs}; expected a whole number of at least 0")


def find_method(name: str) -> Method:
    """Return the method of that name; InputError if there is none."""
    if name not in METHODS:
        raise InputError(f"unknown method {name!r}; expected one of {', '.join(METHODS)}")
    return METHODS[name]
