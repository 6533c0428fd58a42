"""Sizes of the network and the table of motion cues: frozen, hashable, plain values. Does not import jax."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from dataclasses import dataclass, field
from typing import Annotated, Literal

from msgspec import Meta

from vggtjax.errors import InputError
from vggtjax.storage.json_values import Count, Natural, Share, check_fields, parse_json, without_defaults

LARGEST = 1_000_000  # size of one part of a network
Size = Annotated[int, Meta(ge=1, le=LARGEST)]
Gram = Literal["cosine", "dot"]
Suppress = Literal["zero", "drop"]
Attention = Literal["exact", "sampled"]
ComputeDType = Literal["float32", "bfloat16", "float64"]
Precision = Literal["highest", "tf32"]
Threshold = Literal["otsu", "multi-otsu"]
Witness = Literal["gram", "matches"]  # of motion
_MATCHING = (0.5, 0.65)  # relative depths of the pairs that match, where no others are named
VGGT_HEADS = ("camera", "depth", "points", "tracks")  # of the published weights
HEAD_NAMES = VGGT_HEADS  # all heads that the network knows, in the order of `VGGTConfig.heads`


@dataclass(frozen=True)
class Cue:
    """One row of the table of motion cues: a statistic of one Gram map (method of VGGT4D, arXiv 2511.19971).

    The Gram map compares `rows` with `columns`: queries or keys of the global blocks. `layers` are 0-based pair indices
    of a model with `MotionConfig.reference_depth` pairs. An `inverted` map enters the product as 1 - m.
    """

    name: str
    rows: Literal["q", "k"]
    columns: Literal["q", "k"]
    layers: Annotated[tuple[Natural, ...], Meta(min_length=1)]
    statistic: Literal["mean", "std"]
    inverted: bool = False

    def __post_init__(self) -> None:
        check_fields(self, "cue")


@dataclass(frozen=True)
class MotionConfig:
    """The cues, and the frames that each cue is averaged over, as offsets from the reference frame.

    The cues become a saliency in `method.cues`. The score of motion by matches (`method.matching`) reads
    `matching` alone of these values.

    `floor` is added to every map, inverted or not, before the product: 0 in the papers. Each map is 0 at some patch of
    every frame. Without a floor the product is 0 there, whatever the other maps say, which matters where a frame has
    few patches.

    `mask_pairs` is the number of pairs, from the first, in which the second pass suppresses the keys of dynamic tokens
    (L_mask) where the options leave it open. The default is that of the papers for VGGT-1B.

    `threshold` cuts the saliency of every method where the options leave it open; None leaves it to the method.

    `matching` are the pairs of blocks whose global attention matches surfaces between frames, as 0-based indices of a
    model with `reference_depth` pairs; None takes those at 0.5 to 0.65 of the depth.
    """

    cues: Annotated[tuple[Cue, ...], Meta(min_length=1)] = (
        Cue("shallow_kk_mean", "k", "k", (0,), "mean", inverted=True),
        Cue("shallow_qk_std", "q", "k", (0,), "std"),
        Cue("middle_qq_mean", "q", "q", (3, 4, 5, 6, 7), "mean", inverted=True),
        Cue("deep_qq_mean", "q", "q", (17, 18, 19, 20, 21), "mean"),
        Cue("deep_qq_std", "q", "q", (18, 19), "std", inverted=True),
    )
    offsets: Annotated[tuple[int, ...], Meta(min_length=1)] = (-6, -4, -2, 2, 4, 6)
    reference_depth: Count = 24
    floor: Share = 0.0
    mask_pairs: Annotated[int, Meta(ge=0, le=LARGEST)] = 5
    threshold: Threshold | None = None
    matching: Annotated[tuple[Natural, ...], Meta(min_length=1)] | None = None

    def __post_init__(self) -> None:
        check_fields(self, "motion")
        if self.matching is not None and max(self.matching) >= self.reference_depth:
            raise InputError(f"motion.matching is {self.matching}; expected indices in [0, {self.reference_depth})")
        if 0 in self.offsets:
            raise InputError(f"motion.offsets is {self.offsets}; expected frame offsets other than 0")
        for cue in self.cues:
            if max(cue.layers) >= self.reference_depth:
                raise InputError(
                    f"cue '{cue.name}' has layers {cue.layers}; expected indices in [0, {self.reference_depth})"
                )

    @property
    def digest(self) -> str:
        """What tells this table from others, in results."""
        return hashlib.sha256(json.dumps(dataclasses.asdict(self), sort_keys=True).encode()).hexdigest()[:16]

    def layers(self, cue: Cue, depth: int) -> tuple[int, ...]:
        """Return the layers of `cue` in a model with `depth` pairs: round(l (depth - 1) / (reference_depth - 1)).

        A shallower model can contain a layer more than once; its weight grows accordingly.
        """
        if depth == self.reference_depth:
            return cue.layers
        scale = (depth - 1) / max(self.reference_depth - 1, 1)
        return tuple(round(layer * scale) for layer in cue.layers)

    def matching_layers(self, depth: int) -> tuple[int, ...]:
        """Return the pairs of blocks that match in a model with `depth` pairs, at least one.

        By default those of a relative depth from 0.5 to 0.65: 6 and 7 of 12, 12 to 14 of 24. There VGGT's camera poses
        and correspondences form (arXiv 2512.11508, 2512.02541); for VGGT-1B this is an assumption.
        """
        if self.matching is not None:
            scale = (depth - 1) / max(self.reference_depth - 1, 1)
            return tuple(sorted({round(layer * scale) for layer in self.matching}))
        first, last = (share * (depth - 1) for share in _MATCHING)
        return tuple(range(math.ceil(first), int(last) + 1)) or (round(first),)

    def masked_pairs(self, given: int | None) -> int:
        """Return `given`, or the recommended number of pairs if it is None."""
        return self.mask_pairs if given is None else given

    def cut_by(self, given: Threshold | None, own: Threshold) -> Threshold:
        """Return the threshold that is `given`, or else the recommended one, or else the method's `own`."""
        return given or self.threshold or own


_LATER = {name: getattr(MotionConfig, name) for name in ("floor", "mask_pairs", "threshold", "matching")}


@dataclass(frozen=True)
class VGGTConfig:
    """Architecture of a VGGT model (arXiv 2503.11651). The defaults are VGGT-1B.

    The shapes in a checkpoint do not tell the numbers of heads, so a model of another size needs its configuration.
    """

    image_size: Size = 518  # pixels; side of the square of the backbone's positional embedding
    patch_size: Size = 14
    embed_dim: Size = 1024
    depth: Size = 24  # pairs of a frame block and a global block
    num_heads: Size = 16
    dino_depth: Size = 24
    dino_num_heads: Size = 16
    camera_depth: Size = 4
    camera_num_heads: Size = 16
    dpt_features: Size = 256
    dpt_channels: tuple[Size, Size, Size, Size] = (256, 512, 1024, 1024)
    taps: tuple[Natural, Natural, Natural, Natural] = (4, 11, 17, 23)  # pairs whose outputs the dense heads read
    track_features: Size = 128
    track_hidden: Size = 384
    track_corr_levels: Size = 7
    track_corr_radius: Annotated[int, Meta(ge=0, le=LARGEST)] = 4
    track_position_embedding: bool = False
    heads: tuple[str, ...] = VGGT_HEADS  # of the model; a conversion can omit some
    motion: MotionConfig = field(default_factory=MotionConfig)

    def __post_init__(self) -> None:
        check_fields(self)
        if unknown := [name for name in self.heads if name not in HEAD_NAMES]:
            raise InputError(f"heads has {unknown}; expected some of {HEAD_NAMES}")
        if not self.heads or self.heads != tuple(name for name in HEAD_NAMES if name in self.heads):
            raise InputError(f"heads is {self.heads}; expected at least one of {HEAD_NAMES}, in this order")
        if self.image_size % self.patch_size:
            raise InputError(f"image_size {self.image_size} is not a multiple of patch_size {self.patch_size}")
        for channels, heads, multiple in (
            ("embed_dim", "num_heads", 4),  # rotary embedding: quarters for sin and cos of y and of x
            ("embed_dim", "dino_num_heads", 1),
            ("tap_dim", "camera_num_heads", 1),
        ):
            width, count = getattr(self, channels), getattr(self, heads)
            if width % (multiple * count):
                raise InputError(f"{channels} {width} is not a multiple of {multiple} x {heads} {count}")
        if self.dpt_features % 8 or any(channels % 4 for channels in self.dpt_channels):  # sin and cos of x and of y
            raise InputError(
                f"dpt_features {self.dpt_features} is not a multiple of 8, or dpt_channels {self.dpt_channels} of 4"
            )
        if list(self.taps) != sorted(set(self.taps)) or self.taps[-1] >= self.depth:
            raise InputError(
                f"taps is {self.taps}; expected four rising indices of pairs below depth {self.depth}, so depth is at "
                "least 4"
            )

    @property
    def tap_dim(self) -> int:
        """Channels of a tap: outputs of the frame block and of the global block, concatenated."""
        return 2 * self.embed_dim

    @property
    def grid_size(self) -> int:
        """Side of the square grid of patches of the backbone's positional embedding."""
        return self.image_size // self.patch_size

    def to_json(self) -> str:
        """Return the configuration as a JSON object; `from_json` reads it back.

        A floor of 0, the papers' number of pairs, no threshold and no matching pairs are left out, as in files before
        them: digests and cached conversions stay the same.
        """
        values = dataclasses.asdict(self)
        values["motion"] = without_defaults(values["motion"], _LATER)
        return json.dumps(values, separators=(",", ":"))

    @classmethod
    def from_json(cls, text: str) -> VGGTConfig:
        """Read a configuration from JSON text; raises InputError for unknown fields and invalid values."""
        return parse_json(text, cls, "configuration")


def vggt_1b() -> VGGTConfig:
    """Return the configuration of the published VGGT-1B."""
    return VGGTConfig()
