"""The methods as a table, and the options of a reconstruction. Does not import jax."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from vggtjax.config import (
    LARGEST,
    Attention,
    ComputeDType,
    Gram,
    MotionConfig,
    Precision,
    Reference,
    Suppress,
    Threshold,
    Witness,
)
from vggtjax.errors import InputError, check_choice, whole_number
from vggtjax.storage.backend import backend
from vggtjax.storage.json_values import check_fields, without_defaults

Pass = Literal["first", "second"]
MethodName = Literal["vggt", "vggt4d", "pose-decoupling", "hard-replacement", "4dvggt-d", "4dvggt-m"]


@dataclass(frozen=True)
class Method:
    """One row of the table of methods: where depth and cameras come from, and how the dynamic mask is mined.

    `clusters` is the number of clusters of patch features: the saliency is averaged within each cluster before the
    `threshold` is applied; 0 for no clusters. `refine` tells whether the method's depth and cameras refine the mask.
    `mask` is what tells motion: the Gram saliency of the papers, or matches between frames together with it.
    """

    depth: Literal["first", "second", "replaced", "fused"]
    extrinsics: Pass
    intrinsics: Pass
    gram: Gram = "cosine"
    suppress: Suppress = "zero"
    clusters: int = 0
    threshold: Threshold = "otsu"
    refine: bool = False
    mask: Witness = "gram"

    @property
    def needs_second_pass(self) -> bool:
        """Whether the second pass runs, and a mask of what moves is made for it."""
        return {self.depth, self.extrinsics, self.intrinsics} != {"first"}

    def second_outputs(self, align_scale: bool = False) -> tuple[str, ...]:
        """Return the outputs of the second pass: the camera, and depth if the method or `align_scale` reads it."""
        return ("camera", "depth") if self.depth != "first" or align_scale else ("camera",)


# 4DVGGT-D, table 2, and VGGT4D; and 4DVGGT-D with masks from matches, which is not in the papers
METHODS: dict[str, Method] = {
    "vggt": Method("first", "first", "first"),
    "vggt4d": Method("first", "second", "first", "dot", "drop", clusters=64, threshold="multi-otsu", refine=True),
    "pose-decoupling": Method("second", "second", "second"),
    "hard-replacement": Method("replaced", "second", "second"),
    "4dvggt-d": Method("fused", "second", "second"),
    "4dvggt-m": Method("fused", "second", "second", mask="matches"),
}

ABLATION = ("vggt", "pose-decoupling", "hard-replacement", "4dvggt-d")  # one run of both passes serves all four


def find_method(name: str) -> Method:
    """Return the method of that name. Raises InputError for an unknown name."""
    check_choice("method", name, tuple(METHODS))
    return METHODS[name]


def odd_frames(frames: object) -> int:
    """Return a number of frames to average over as an int. Raises InputError for an invalid number."""
    number = whole_number("smooth_frames", frames, 1)
    if number % 2 == 0:
        raise InputError(f"smooth_frames is {number}; expected an odd number of frames, such as 3")
    return number


def pairs_to_try(pairs: Sequence[int], depth: int | None = None) -> tuple[int, ...]:
    """Return different numbers of pairs in order.

    Raises InputError for none, and for a number outside [1, `depth`], the pairs of a model.
    """
    numbers = tuple(sorted({whole_number("mask_pairs", number, 1) for number in pairs}))
    if not numbers:
        raise InputError(f"mask_pairs is {list(pairs)}; expected numbers of pairs to try, such as 1 3 5")
    if depth is not None and numbers[-1] > depth:
        raise InputError(f"mask_pairs is {list(pairs)}; expected numbers from 1 to {depth}, the pairs of the model")
    return numbers


_READ_AFTER_THE_PASSES = ("method", "align_scale", "refine_mask", "refine_cameras", "consistent_depth")


_LATER = {
    "refine_cameras": False,
    "consistent_depth": False,
    "attention": "exact",
    "precision": "highest",
    "reference": "chosen",
}  # as in older results


@dataclass(frozen=True)
class Options:
    """How a clip is reconstructed. Raises InputError for an invalid value.

    Attributes:
        method: which passes give depth and cameras: vggt, the first pass; vggt4d, depth of the first and cameras of the
            second; pose-decoupling, the second pass; hard-replacement, the second pass, with depth of the first where
            things move; 4dvggt-d, the same, with the depth of both passes fused where nothing moves; 4dvggt-m, as
            4dvggt-d, with masks from matches
        gram: similarity of the motion cues; by default dot for vggt4d, else cosine
        suppress: how the second pass ignores keys of dynamic tokens; by default drop for vggt4d, else zero
        mask_pairs: in how many pairs of blocks, from the first on, keys of dynamic tokens are ignored (L_mask of the
            paper); by default the number that the model recommends, 5 for VGGT-1B
        threshold: where the saliency is cut: otsu, one threshold; multi-otsu, the highest of up to three, usually with
            a smaller mask; by default what the model recommends, else multi-otsu for vggt4d and otsu for the others
        mask: what tells motion: gram, the similarity of tokens, as in the papers; matches, the same and the matches
            between frames that do not fit a static world (not in the papers); by default matches for 4dvggt-m, else
            gram
        align_scale: scale the second pass to the first pass before it is used (not in the paper)
        smooth_frames: an odd number of frames, each with its neighbours, over which the score of motion is averaged
            before the mask is cut from it, so that masks flicker less; 1: every frame by itself, as in the papers
        refine_mask: remove pixels from the mask that agree with other frames; the method's own choice by default
        refine_cameras: adjust cameras and focal length to matches between the source's pictures, where nothing moves
            (bundle adjustment; needs the extra colmap)
        consistent_depth: fit depth, cameras and focal length to the pixels of the source, and join what several frames
            see, where nothing moves (not in the papers; the default of the commands reconstruct and batch); with
            --refine-cameras its points are fitted too
        compute_dtype: number type of the transformer's matrix products; by default bfloat16 on a GPU or TPU, and on a
            CPU float32, or bfloat16 if reconstruct runs a large model and a short trial finds it faster there
        precision: of the depth heads and motion cues on a GPU or TPU: tf32, the default, fast, about three decimal
            digits; highest, float32, about seven digits, and then --dtype is float32 by default too. A CPU always
            computes them in float32
        attention: how frames attend to each other: exact; sampled, an approximation that sees a third of the tokens of
            other frames: faster for long clips, with other numbers (its errors are in the docs)
        reference: the frame that Depth Anything 3 looks at first: chosen, the most ordinary one; first or middle, by
            its place in the clip. VGGT always takes the first
    """

    method: MethodName = "4dvggt-d"
    gram: Gram | None = None
    suppress: Suppress | None = None
    mask_pairs: int | None = None
    threshold: Threshold | None = None
    mask: Witness | None = None
    align_scale: bool = False
    smooth_frames: int = 1
    refine_mask: bool | None = None
    refine_cameras: bool = False
    consistent_depth: bool = False
    compute_dtype: ComputeDType | None = None
    precision: Precision | None = None
    attention: Attention = "exact"
    reference: Reference = "chosen"

    def __post_init__(self) -> None:
        find_method(self.method)
        if self.mask_pairs is not None:
            object.__setattr__(self, "mask_pairs", whole_number("mask_pairs", self.mask_pairs, 0))
            if self.mask_pairs > LARGEST:
                raise InputError(f"mask_pairs is {self.mask_pairs}; expected at most {LARGEST}")
        object.__setattr__(self, "smooth_frames", odd_frames(self.smooth_frames))
        check_fields(self)

    def check_given_masks(self) -> None:
        """Raise InputError for options of mined masks; call it where the user gives masks, before `resolved`."""
        if self.smooth_frames != 1:
            raise InputError(f"smooth_frames is {self.smooth_frames}; leave it out, as given masks are not smoothed")
        if self.threshold is not None:
            raise InputError(f"threshold is {self.threshold!r}; leave it out, as given masks are not mined")
        if self.mask is not None:
            raise InputError(f"mask is {self.mask!r}; leave it out, as given masks are not mined")

    @property
    def row(self) -> Method:
        """The method's row, with gram, suppress, threshold, refine and mask overridden where they are given."""
        method = METHODS[self.method]
        return dataclasses.replace(
            method,
            gram=self.gram or method.gram,
            suppress=self.suppress or method.suppress,
            threshold=self.threshold or method.threshold,
            refine=method.refine if self.refine_mask is None else self.refine_mask,
            mask=self.mask or method.mask,
        )

    def resolved(self, motion: MotionConfig, on_accelerator: bool | None = None) -> Options:
        """Return the options with the values of the method, the model and the platform in place of None.

        `motion` is the model's. `on_accelerator` is as for `computed`.
        """
        row = self.row
        return dataclasses.replace(
            self.computed(on_accelerator),
            gram=row.gram,
            suppress=row.suppress,
            refine_mask=row.refine,
            mask_pairs=motion.masked_pairs(self.mask_pairs),
            threshold=motion.cut_by(self.threshold, row.threshold),
            mask=row.mask,
        )

    def computed(self, on_accelerator: bool | None = None) -> Options:
        """Return the options with the platform's types in place of None.

        `on_accelerator` tells whether the network will be computed on a GPU or TPU; by default, whether jax has one. A
        CPU computes in float32 whatever is given: there the precision is the highest.
        """
        dtype, precision = self.compute_dtype, self.precision
        if dtype is None or precision != "highest":
            narrow = precision != "highest" and (has_accelerator() if on_accelerator is None else on_accelerator)
            dtype, precision = dtype or ("bfloat16" if narrow else "float32"), "tf32" if narrow else "highest"
        return dataclasses.replace(self, compute_dtype=dtype, precision=precision)

    def passes_settings(self, motion: MotionConfig) -> dict[str, Any]:
        """What the two passes of a model depend on, as JSON values; methods with equal values share one run of them."""
        options = self.resolved(motion)
        settings = options.to_json() | {"clusters": options.row.clusters, "threshold": options.threshold}
        settings.pop("mask", None)  # absent where it is the papers', whatever the method
        settings |= {} if options.mask == "gram" else {"mask": options.mask}
        return {name: value for name, value in settings.items() if name not in _READ_AFTER_THE_PASSES}

    def changed(self, **changes: Any) -> Options:
        """Return the options with other values. Raises TypeError for an unknown name."""
        names = [field.name for field in dataclasses.fields(self)]
        if unknown := sorted(changes.keys() - set(names)):
            raise TypeError(f"no option is named {' or '.join(unknown)}; expected {names}")
        return dataclasses.replace(self, **changes) if changes else self

    def to_json(self) -> dict[str, Any]:
        """Return the options as JSON values, without those of `_LATER` at their default: as in results before them.

        A threshold is among them if it is not the method's own, so that it is lost where the model recommends another
        one: resolve the options first.
        """
        values = without_defaults(dataclasses.asdict(self), _LATER)
        if self.threshold in (None, METHODS[self.method].threshold):
            del values["threshold"]
        if self.mask in (None, METHODS[self.method].mask):
            del values["mask"]
        return values


def has_accelerator() -> bool:
    """Return whether jax has a GPU or TPU."""
    return backend() != "cpu"
