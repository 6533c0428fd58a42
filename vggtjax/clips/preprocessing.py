"""Frames of any size as frames of the model's size, the way the model was trained. Does not import jax."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image

from vggtjax.clips.media.sampling import Frame
from vggtjax.clips.opencv_resize import resized
from vggtjax.config import VGGTConfig
from vggtjax.errors import ClipError, InputError, check_choice, whole_number

Mode = Literal["crop", "pad", "fit"]

_MOST_PIXELS = 2**26  # of a resized frame, before it is cut: 8192 x 8192


@dataclass(frozen=True)
class Framing:
    """How pictures are fitted to the model. Raises InputError for an invalid value.

    Attributes:
        mode: crop makes frames `size` wide and cuts tall frames above and below to `size`; pad keeps every pixel and
            pads to a square; fit makes the long side `size` and keeps every pixel; by default as the model was trained:
            crop for VGGT, fit for Depth Anything 3
        size: side in pixels to run at, a multiple of the model's patch size; the model's own size by default
    """

    mode: Mode | None = None
    size: int | None = None

    def __post_init__(self) -> None:
        if self.mode is not None:
            check_choice("mode", self.mode, get_args(Mode))
        if self.size is not None:
            object.__setattr__(self, "size", whole_number("size", self.size, 1))

    def fitter(self, config: VGGTConfig) -> Fitter:
        """Return the fitter for a model of this configuration: at its size, unless `size` is given, and its patches."""
        size = config.clip_size if self.size is None else self.size
        return Fitter(self.mode or config.row.clip_mode, size, config.patch_size)


@dataclass(frozen=True)
class Fitter:
    """Fits pictures to frames whose sides are multiples of `patch`; see `Framing` for `mode` and `size`.

    Raises InputError for an invalid value.
    """

    mode: Mode = "crop"
    size: int = 518
    patch: int = 14

    def __post_init__(self) -> None:
        Framing(self.mode, self.size)
        object.__setattr__(self, "patch", whole_number("patch", self.patch, 1))
        object.__setattr__(self, "size", whole_number("size", self.size, 1))
        if self.size % self.patch:
            raise InputError(f"size is {self.size}; expected a multiple of patch {self.patch}")

    def fit(self, width: int, height: int, name: str) -> Fit:
        """Return where a picture of `width` x `height` pixels lands; the error says `name`.

        Raises ClipError for a picture so narrow or so long that a side becomes 0 or the resized picture huge.
        """
        whole = None
        # The order of these operations decides how halves round; it is that of VGGT and, for "fit", Depth Anything 3.
        if self.mode == "fit":
            scale = self.size / max(width, height)
            whole = (round(width * scale), round(height * scale))
            resized_width, resized_height = (int(side / self.patch + 0.5) * self.patch for side in whole)
        elif self.mode == "crop" or width >= height:
            resized_width = self.size
            resized_height = round(height * (self.size / width) / self.patch) * self.patch
        else:
            resized_height = self.size
            resized_width = round(width * (self.size / height) / self.patch) * self.patch
        if not resized_width or not resized_height or resized_width * resized_height > _MOST_PIXELS:
            remedy = "cut it to a less extreme shape" if self.size**2 <= _MOST_PIXELS else "choose a smaller size"
            raise ClipError(
                f"frame {name} is {width} x {height}, which becomes {resized_width} x {resized_height} at size "
                f"{self.size} and patch {self.patch}; {remedy}"
            )
        frame_size = (resized_width, min(resized_height, self.size))
        fit = Fit(
            source_size=(width, height),
            resized_size=(resized_width, resized_height),
            cut=(resized_height - frame_size[1]) // 2,
            frame_size=frame_size,
            box=(0, 0, *frame_size),
            whole=whole,
        )
        return fit.widen(self.size, self.size) if self.mode == "pad" else fit


@dataclass(frozen=True)
class Fit:
    """Where a picture lands in a frame of the clip: resized, cut above and below, placed on white.

    Sizes are (width, height). The first `cut` rows of the resized picture are removed; the rest fills `box`
    (left, top, right, bottom) of the frame. Continuous coordinates have pixel edges at whole numbers, and
    source = scale * frame + offset in (x, y). With a `whole` size, the picture is first resized to it.
    """

    source_size: tuple[int, int]
    resized_size: tuple[int, int]
    cut: int
    frame_size: tuple[int, int]
    box: tuple[int, int, int, int]
    whole: tuple[int, int] | None = None

    @property
    def cut_share(self) -> float:
        """Share of the source's pixels above and below the frame."""
        return 1 - (self.box[3] - self.box[1]) / self.resized_size[1]

    @property
    def scale(self) -> tuple[float, float]:
        """Source pixels per frame pixel."""
        return self.source_size[0] / self.resized_size[0], self.source_size[1] / self.resized_size[1]

    @property
    def offset(self) -> tuple[float, float]:
        """Source coordinates of the frame's upper left corner."""
        return -self.box[0] * self.scale[0], (self.cut - self.box[1]) * self.scale[1]

    def widen(self, width: int, height: int) -> Fit:
        """Return the fit of the same frame centred in a larger frame; an odd remainder is added right and below."""
        right, down = (width - self.frame_size[0]) // 2, (height - self.frame_size[1]) // 2
        left, top, *ends = self.box
        box = (left + right, top + down, ends[0] + right, ends[1] + down)
        return dataclasses.replace(self, frame_size=(width, height), box=box)

    def render(self, frame: Frame) -> UInt8[np.ndarray, "H W 3"] | Float32[np.ndarray, "H W 3"]:
        """Return a frame of `source_size` as one of the clip, in 8 bits.

        A frame that is given as floating point, and not resized, keeps its values in [0, 1].
        """
        left, top, right, bottom = self.box
        if frame.exact is not None and self.resized_size == self.source_size:
            pixels, white = frame.exact, 1
        elif self.whole is not None:
            pixels, white = resized(resized(np.asarray(frame.image), self.whole), self.resized_size), 255
        else:
            pixels, white = np.asarray(frame.image.resize(self.resized_size, Image.Resampling.BICUBIC)), 255
        fitted = np.full((*self.frame_size[::-1], 3), white, pixels.dtype)
        fitted[top:bottom, left:right] = pixels[self.cut : self.cut + bottom - top]
        return fitted
