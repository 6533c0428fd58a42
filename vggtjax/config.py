"""Sizes of the network and the table of motion cues: frozen, hashable, plain values. Does not import jax."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from msgspec import Meta

from vggtjax.errors import InputError, check_choice
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
Reference = Literal["chosen", "first", "middle"]
_MATCHING = (0.5, 0.65)  # relative depths of the pairs that match, where no others are named
VGGT_HEADS = ("camera", "depth", "points", "tracks")  # of the published weights


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


@dataclass(frozen=True)
class Family:
    """What tells the networks of one family from those of another, beside their sizes: a row of `FAMILIES`."""

    heads: tuple[str, ...]  # that it can have
    registers: int  # tokens of each frame beside its camera token and its patches
    clip_mode: Literal["crop", "fit"]  # how frames are made of pictures by default: see `Framing`
    clip_size: int  # pixels a side of frames by default, at most
    block_epsilon: float  # of the norms of a pair's blocks
    norms_features: bool  # the backbone's last norm is for its features; else for the taps, in their global half
    flat_positions: bool  # in global blocks all patches rotate alike; else by their place in the frame
    places_by_scale: bool  # how the table of positions is resized: by a scale, sharply; else by size, with antialias
    chooses_reference: bool  # the frame with the first camera token; else the clip's first frame
    takes_cameras: bool  # as camera tokens
    relu_in_place: bool  # skips of the dense heads add relu(x); else x
    world_is_first: bool  # predicted cameras are in the coordinates of the clip's first one; else in free ones
    direct_cameras: bool  # camera-to-world, from a camera token alone; else camera-from-world, by iterations


FAMILIES = {
    "vggt": Family(
        VGGT_HEADS,
        registers=4,
        clip_mode="crop",
        clip_size=LARGEST,
        block_epsilon=1e-5,
        norms_features=True,
        flat_positions=False,
        places_by_scale=False,
        chooses_reference=False,
        takes_cameras=False,
        relu_in_place=True,
        world_is_first=True,
        direct_cameras=False,
    ),
    "da3": Family(
        ("camera", "depth", "rays"),
        registers=0,
        clip_mode="fit",
        clip_size=504,
        block_epsilon=1e-6,
        norms_features=False,
        flat_positions=True,
        places_by_scale=True,
        chooses_reference=True,
        takes_cameras=True,
        relu_in_place=False,
        world_is_first=False,
        direct_cameras=True,
    ),
}
_LATER = {name: getattr(MotionConfig, name) for name in ("floor", "mask_pairs", "threshold", "matching")}


@dataclass(frozen=True)
class VGGTConfig:
    """Architecture of a VGGT (arXiv 2503.11651) or Depth Anything 3 (arXiv 2511.10647). The defaults are VGGT-1B.

    The shapes in a checkpoint do not tell the numbers of heads, so a model of another size needs its configuration.
    """

    image_size: Size = 518  # pixels; side of the square of the backbone's positional embedding
    patch_size: Size = 14
    embed_dim: Size = 1024
    depth: Size = 24  # pairs of a frame block and a global block
    num_heads: Size = 16
    dino_depth: Size = 24
    dino_num_heads: Size = 16
    camera_depth: Annotated[int, Meta(ge=0, le=LARGEST)] = 4  # blocks of the camera head, or of the encoder of cameras
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
    family: str = "vggt"  # a row of `FAMILIES`
    gated_mlp: Annotated[int, Meta(ge=0, le=LARGEST)] = 0  # hidden channels of the blocks' SwiGLU; 0: GELU with 4 C
    leading_global: bool = False  # whether one global block comes before the pairs

    def __post_init__(self) -> None:
        check_fields(self)
        check_choice("family", self.family, tuple(FAMILIES))
        if unknown := [name for name in self.heads if name not in self.row.heads]:
            raise InputError(f"heads has {unknown}; expected some of {self.row.heads}")
        known = self.row.heads
        if not self.heads or self.heads != tuple(name for name in known if name in self.heads):
            raise InputError(f"heads is {self.heads}; expected at least one of {known}, in this order")
        if "rays" in self.heads and "depth" not in self.heads:
            raise InputError(f"heads is {self.heads}; expected depth with rays, which read its maps")
        if not self.camera_depth and not self.row.takes_cameras:
            raise InputError(f"camera_depth is 0; expected at least 1 in a model of the family {self.family}")
        if self.image_size % self.patch_size:
            raise InputError(f"image_size {self.image_size} is not a multiple of patch_size {self.patch_size}")
        for channels, heads, multiple in (
            ("embed_dim", "num_heads", 4),  # rotary embedding: quarters for sin and cos of y and of x
            ("embed_dim", "dino_num_heads", 1),
            ("embed_dim" if self.row.takes_cameras else "tap_dim", "camera_num_heads", 1),
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
    def row(self) -> Family:
        """The row of the model's family."""
        return FAMILIES[self.family]

    @property
    def special_tokens(self) -> int:
        """Tokens of each frame before its patches, in the pairs of blocks: a camera token and registers."""
        return 1 + self.row.registers

    @property
    def reads_cameras(self) -> bool:
        """Whether known cameras are tokens of the network: the family takes them, and the model has their encoder."""
        return self.row.takes_cameras and self.camera_depth > 0

    @property
    def clip_size(self) -> int:
        """Pixels a side of frames, unless others are asked for."""
        return min(self.image_size, self.row.clip_size)

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
        values = without_defaults(dataclasses.asdict(self), _LATER_SIZES)
        values["motion"] = without_defaults(values["motion"], _LATER)
        return json.dumps(values, separators=(",", ":"))

    @classmethod
    def from_json(cls, text: str) -> VGGTConfig:
        """Read a configuration from JSON text; raises InputError for unknown fields and invalid values."""
        return parse_json(text, cls, "configuration")


_LATER_SIZES = {name: getattr(VGGTConfig, name) for name in ("family", "gated_mlp", "leading_global")}


def vggt_1b() -> VGGTConfig:
    """Return the configuration of the published VGGT-1B."""
    return VGGTConfig()


def _da3(embed_dim: int, encoder: int, taps: tuple, features: int, channels: tuple, **sizes: Any) -> VGGTConfig:
    """Return the configuration of a Depth Anything 3 with `encoder` blocks before its pairs; the last pair is tapped.

    Its table of motion cues is VGGT-1B's by relative depth, and so is the number of masked pairs: both unmeasured.
    """
    heads, depth = embed_dim // 64, taps[-1] + 1
    return VGGTConfig(
        embed_dim=embed_dim,
        depth=depth,
        num_heads=heads,
        dino_depth=encoder,
        dino_num_heads=heads,
        dpt_features=features,
        dpt_channels=channels,
        taps=taps,
        heads=FAMILIES["da3"].heads,
        motion=MotionConfig(mask_pairs=round(5 / 24 * depth)),
        family="da3",
        **sizes,
    )


DA3 = {  # by the names in the published config.json
    "da3-small": _da3(384, 4, (0, 1, 2, 3), 64, (48, 96, 192, 384)),
    "da3-base": _da3(768, 4, (0, 1, 2, 3), 128, (96, 192, 384, 768)),
    "da3-large": _da3(1024, 8, (1, 3, 5, 7), 256, (256, 512, 1024, 1024)),
    "da3-giant": _da3(1536, 13, (2, 6, 9, 12), 256, (256, 512, 1024, 1024), gated_mlp=4096, leading_global=True),
}

PUBLISHED = {"VGGT-1B": vggt_1b()} | {name.upper(): config for name, config in DA3.items()}
