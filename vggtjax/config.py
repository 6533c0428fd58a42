"""Sizes of the network and the table of motion cues: frozen, hashable, plain values. Does not import jax."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from vggtjax.errors import InputError

Gram = Literal["cosine", "dot"]
Suppress = Literal["zero", "drop"]
HEAD_NAMES = ("camera", "depth", "points", "tracks")


@dataclass(frozen=True)
class Cue:
    """One row of the table of motion cues: a statistic of one Gram map (method of VGGT4D, arXiv 2511.19971).

    `rows` and `columns` say which of q and k of the global blocks the Gram map compares; `layers` are 0-based pair
    indices of a model with `MotionConfig.reference_depth` pairs; an `inverted` map enters the product as 1 - m.
    """

    name: str
    rows: Literal["q", "k"]
    columns: Literal["q", "k"]
    layers: tuple[int, ...]
    statistic: Literal["mean", "std"]
    inverted: bool = False


@dataclass(frozen=True)
class MotionConfig:
    """The cues, and the frames (as offsets from the reference frame) that they are averaged over."""

    cues: tuple[Cue, ...] = (
        Cue("shallow_kk_mean", "k", "k", (0,), "mean", inverted=True),
        Cue("shallow_qk_std", "q", "k", (0,), "std"),
        Cue("middle_qq_mean", "q", "q", (3, 4, 5, 6, 7), "mean", inverted=True),
        Cue("deep_qq_mean", "q", "q", (17, 18, 19, 20, 21), "mean"),
        Cue("deep_qq_std", "q", "q", (18, 19), "std", inverted=True),
    )
    offsets: tuple[int, ...] = (-6, -4, -2, 2, 4, 6)
    reference_depth: int = 24

    def __post_init__(self) -> None:
        object.__setattr__(self, "offsets", tuple(self.offsets))
        object.__setattr__(self, "cues", tuple(_cue(cue) for cue in self.cues))
        if not self.cues:
            raise InputError("motion.cues is empty; at least one cue is needed")
        if not self.offsets or not all(type(offset) is int and offset for offset in self.offsets):
            raise InputError(f"motion.offsets is {self.offsets}; expected frame offsets, whole numbers other than 0")
        if type(self.reference_depth) is not int or self.reference_depth < 1:
            raise InputError(f"motion.reference_depth is {self.reference_depth!r}; expected a whole number above 0")
        for cue in self.cues:
            wrong = [layer for layer in cue.layers if type(layer) is not int or not 0 <= layer < self.reference_depth]
            if wrong or not cue.layers:
                raise InputError(
                    f"cue '{cue.name}' has layers {cue.layers}; expected indices in [0, {self.reference_depth})"
                )

    def layers(self, cue: Cue, depth: int) -> tuple[int, ...]:
        """Layers of `cue` in a model with `depth` pairs: l becomes round(l (depth - 1) / (reference_depth - 1)).

        A shallower model can read a layer more than once, which then weighs more.
        """
        if depth == self.reference_depth:
            return cue.layers
        scale = (depth - 1) / max(self.reference_depth - 1, 1)
        return tuple(round(layer * scale) for layer in cue.layers)


@dataclass(frozen=True)
class VGGTConfig:
    """Architecture of a VGGT model (arXiv 2503.11651). The defaults are VGGT-1B.

    Head counts cannot be read off a checkpoint's shapes, so a model of another size names its configuration.
    """

    image_size: int = 518  # pixels; the square that the positional embedding of the backbone covers
    patch_size: int = 14
    embed_dim: int = 1024
    depth: int = 24  # alternating pairs: a frame block and a global block each
    num_heads: int = 16
    dino_depth: int = 24
    dino_num_heads: int = 16
    camera_depth: int = 4
    camera_num_heads: int = 16
    dpt_features: int = 256
    dpt_channels: tuple[int, int, int, int] = (256, 512, 1024, 1024)
    taps: tuple[int, int, int, int] = (4, 11, 17, 23)  # pairs whose output the dense heads read
    track_features: int = 128
    track_hidden: int = 384
    track_corr_levels: int = 7
    track_corr_radius: int = 4
    track_position_embedding: bool = False
    heads: tuple[str, ...] = HEAD_NAMES  # that the model has; a conversion can leave some out
    motion: MotionConfig = field(default_factory=MotionConfig)

    def __post_init__(self) -> None:
        for name in ("dpt_channels", "taps"):
            value = tuple(getattr(self, name))
            object.__setattr__(self, name, value)
            if len(value) != 4:
                raise InputError(f"{name} is {value}; expected four numbers")
        object.__setattr__(self, "heads", tuple(self.heads))
        if not self.heads or self.heads != tuple(name for name in HEAD_NAMES if name in self.heads):
            raise InputError(f"heads is {self.heads}; expected at least one of {HEAD_NAMES}, in this order")
        if isinstance(self.motion, Mapping):
            object.__setattr__(self, "motion", MotionConfig(**self.motion))
        if not isinstance(self.motion, MotionConfig):
            raise InputError(f"motion is {self.motion!r}; expected the fields of a MotionConfig")
        for field_ in dataclasses.fields(self):
            value = getattr(self, field_.name)
            values = value if isinstance(value, tuple) else (value,)
            lowest = 0 if field_.name in ("taps", "track_corr_radius") else 1
            if field_.name not in ("motion", "track_position_embedding", "heads") and not all(
                type(v) is int and lowest <= v <= 1_000_000 for v in values
            ):
                raise InputError(f"{field_.name} is {value!r}; expected whole numbers of at least {lowest}")
        if type(self.track_position_embedding) is not bool:
            raise InputError(f"track_position_embedding is {self.track_position_embedding!r}; expected true or false")
        if self.image_size % self.patch_size:
            raise InputError(f"image_size {self.image_size} is not a multiple of patch_size {self.patch_size}")
        for channels, heads, multiple in (
            ("embed_dim", "num_heads", 4),  # a quarter of each head turns with sin/cos of y, a quarter of x
            ("embed_dim", "dino_num_heads", 1),
            ("camera_dim", "camera_num_heads", 1),
        ):
            if getattr(self, channels) % (multiple * getattr(self, heads)):
                raise InputError(
                    f"{channels} {getattr(self, channels)} is not a multiple of {multiple} x {heads} "
                    f"{getattr(self, heads)}"
                )
        if self.dpt_features % 8 or any(channels % 4 for channels in self.dpt_channels):  # sin and cos of x and of y
            raise InputError(
                f"dpt_features {self.dpt_features} is not a multiple of 8, or dpt_channels {self.dpt_channels} of 4"
            )
        if list(self.taps) != sorted(set(self.taps)) or self.taps[-1] >= self.depth:
            raise InputError(f"taps is {self.taps}; expected rising pair indices below depth {self.depth}")

    @property
    def camera_dim(self) -> int:
        """Channels of a tap: the frame block's output next to the global block's."""
        return 2 * self.embed_dim

    @property
    def grid_size(self) -> int:
        """Side of the square grid of patches that the backbone's positional embedding covers."""
        return self.image_size // self.patch_size

    def to_json(self) -> str:
        """Return the configuration as a JSON object; `from_json` reads it back."""
        return json.dumps(dataclasses.asdict(self), separators=(",", ":"))

    @classmethod
    def from_json(cls, text: str) -> VGGTConfig:
        """Read a configuration from JSON text, such as a checkpoint's metadata.

        Raises InputError for text that is not a JSON object of known fields with valid values.
        """
        try:
            values = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise InputError(f"configuration is not JSON: {error}") from None
        if not isinstance(values, dict):
            raise InputError(f"configuration is a JSON {type(values).__name__}; expected an object")
        unknown = sorted(set(values) - {f.name for f in dataclasses.fields(cls)})
        if unknown:
            raise InputError(f"configuration has unknown fields {unknown}")
        try:
            return cls(**values)
        except TypeError as error:
            raise InputError(f"configuration has a value of the wrong type: {error}") from None


def vggt_1b() -> VGGTConfig:
    """Return the configuration of the published VGGT-1B."""
    return VGGTConfig()


def _cue(value: Cue | Mapping[str, Any]) -> Cue:
    cue = Cue(**value) if isinstance(value, Mapping) else value
    if not isinstance(cue, Cue):
        raise InputError(f"a cue is {cue!r}; expected the fields of a Cue")
    choices = {"rows": ("q", "k"), "columns": ("q", "k"), "statistic": ("mean", "std"), "inverted": (True, False)}
    for name, allowed in choices.items():
        if getattr(cue, name) not in allowed:
            raise InputError(f"cue '{cue.name}' has {name}={getattr(cue, name)!r}; expected one of {allowed}")
    return dataclasses.replace(cue, layers=tuple(cue.layers))
