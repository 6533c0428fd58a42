"""Frames in memory as arrays, and values of 8, 16 or 32 bits as 8 bits. Does not import jax."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from vggtjax.clips.media.sampling import Frame, Sampling
from vggtjax.errors import ClipError

_SLACK = 1e-3  # largest distance of a floating-point value from [0, 1] that counts as rounding


@dataclass(frozen=True, eq=False)
class ArrayFrames:
    """Frames [H, W, 3] in memory: uint8, uint16 or floating point in [0, 1]. The arrays are kept, not copied."""

    arrays: tuple[np.ndarray, ...]
    name: str = ""

    @classmethod
    def from_arrays(cls, arrays: Any) -> ArrayFrames:
        """Take one array [S, H, W, 3] or a sequence of arrays [H, W, 3]; raise ClipError for any other shape."""
        if not isinstance(arrays, Sequence):
            stacked = np.asarray(arrays)
            if stacked.ndim != 4:
                remedy = "give the clips of a batch one by one" if stacked.ndim == 5 else "expected frames [S, H, W, 3]"
                raise ClipError(f"the array has shape {stacked.shape}; {remedy}")
            if stacked.shape[3] != 3 and stacked.shape[1] == 3:
                raise ClipError(
                    f"the array has shape {stacked.shape}, colours first; expected frames [S, H, W, 3]: "
                    "array.transpose(0, 2, 3, 1), or tensor.permute(0, 2, 3, 1)"
                )
            arrays = stacked
        frames = tuple(np.asarray(array) for array in arrays)
        if not frames:
            raise ClipError("the array holds no frames; expected at least one")
        for index, frame in enumerate(frames):
            if frame.ndim != 3 or frame.shape[2] != 3 or frame.size == 0:
                first = frame.ndim == 3 and frame.shape[0] == 3
                remedy = ": put colours last, array.transpose(1, 2, 0)" if first else ", none empty"
                raise ClipError(f"frame {frame_name(index)} has shape {frame.shape}; expected [H, W, 3]{remedy}")
        if all(frame.dtype.kind == "u" and frame.itemsize == 2 and frame.max() <= 255 for frame in frames):
            raise ClipError(
                "the frames are uint16 and have no value above 255, so they would be black, as 65535 is white; give "
                "array.astype(np.uint8)"
            )
        return cls(frames)

    def total(self, sampling: Sampling) -> int:
        """Return how many frames `sampling` takes."""
        return len(sampling.indices(len(self.arrays)))

    def frames(self, sampling: Sampling) -> Iterator[Frame]:
        """Yield the frames that `sampling` takes, named by their index."""
        for index in sampling.indices(len(self.arrays)):
            name, values = frame_name(index), self.arrays[index]
            image = Image.fromarray(eight_bit(values, name))
            is_float = np.issubdtype(values.dtype, np.floating)
            exact = values.astype(np.float32).clip(0, 1) if is_float else None
            yield Frame(name, image, exact=exact, index=index)


def frame_name(index: int) -> str:
    """Return the name of a frame without a file name: its index in the source."""
    return f"{index:06d}"


def eight_bit(values: np.ndarray, name: str) -> np.ndarray:
    """Return uint8, uint16, or floating-point values in [0, 1] as uint8; the largest value of the type becomes 255.

    Values are rounded to nearest. Raises ClipError, with the frame's `name`, for another type, or a floating-point
    value that is not finite or not in [0, 1].
    """
    if values.dtype == np.uint8:
        return values
    if np.issubdtype(values.dtype, np.uint16):
        return ((values.astype(np.uint32) + 128) // 257).astype(np.uint8)  # 65535 = 255 * 257
    if not np.issubdtype(values.dtype, np.floating):
        raise ClipError(f"frame {name} has values of type {values.dtype}; expected uint8, uint16 or floating point")
    lowest, highest = values.min(), values.max()
    if not (np.isfinite(lowest) and np.isfinite(highest)):
        raise ClipError(f"frame {name} has values that are not finite; expected floating point in [0, 1]")
    if lowest < -_SLACK or highest > 1 + _SLACK:
        raise ClipError(
            f"frame {name} has values from {lowest:g} to {highest:g}; expected floating point in [0, 1], or uint8"
        )
    return in_bytes(values.astype(np.float32).clip(0, 1))


def in_bytes(images: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Return images in [0, 1] as 8 bits, rounded to nearest, as results store them."""
    return np.rint(255 * images).astype(np.uint8)
