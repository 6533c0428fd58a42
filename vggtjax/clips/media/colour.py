"""Frames of a video as 8-bit sRGB: which colours a video's tags mean, and HDR as SDR. Does not import jax."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

if TYPE_CHECKING:
    from av import VideoCodecContext, VideoFrame

# Numbers of ITU-T H.273, which all containers and codecs share.
_UNKNOWN = (None, 0, 2, 3)
_UNKNOWN_MATRIX = (None, 2, 3)  # 0 is RGB
_BT709, _BT2020, _P3, _PQ, _HLG = 1, 9, 12, 16, 18
_LIGHTNESS_ONLY = (14, 15)  # ICtCp and IPT, as in Dolby Vision's profile 5, are not YCbCr
_SWSCALE = {6: 5, 10: _BT2020}  # swscale has one number for both forms of BT.601, and one for both of BT.2020
_HD_LINES, _HD_COLUMNS = 720, 1280  # from either on, a video without tags is BT.709; below, swscale takes BT.601

_WHITE = 203  # nits of SDR's white in HDR (ITU-R BT.2408)
HDR = (_HLG, _PQ)  # transfer
WIDE = (_BT2020, _P3)  # primaries
_PEAKS = {_HLG: 1000 / _WHITE, _PQ: 10000 / _WHITE}  # brightest value; HLG as on BT.2100's display of 1000 nits
_NAMES = {_HLG: "HLG", _PQ: "PQ"}
_HLG_GAMMA = 1.2  # of that display
_KNEE = 0.92  # linear; brighter values roll off, so that white itself is 251 of 255

# RGB to XYZ with white D65; the second row is the luminance.
_XYZ = {
    _BT709: ((0.412391, 0.357584, 0.180481), (0.212639, 0.715169, 0.072192), (0.019331, 0.119195, 0.950532)),
    _BT2020: ((0.636958, 0.144617, 0.168881), (0.262700, 0.677998, 0.059302), (0.0, 0.028073, 1.060985)),
    _P3: ((0.486571, 0.265668, 0.198217), (0.228975, 0.691739, 0.079287), (0.0, 0.045113, 1.043944)),
}
_BAND = 2**20  # pixels converted at once
_STEPS = 2**16


@dataclass(frozen=True)
class Colours:
    """What a video's tags say of its colours, as numbers of H.273."""

    matrix: int | None  # of YCbCr; None where only swscale's default is left
    transfer: int
    primaries: int

    @property
    def is_plain(self) -> bool:
        """Whether values are shown as they are: SDR in the primaries of sRGB, or in such as are close to them."""
        return self.transfer not in _PEAKS and self.primaries not in WIDE

    @property
    def note(self) -> str | None:
        """What is done to colours that are not plain, in words."""
        if self.transfer in _PEAKS:
            return f"is HDR ({_NAMES[self.transfer]}); it is read as SDR, with white at {_WHITE} nits"
        return None if self.is_plain else "has a wide gamut; its colours are read as sRGB"

    @property
    def is_readable(self) -> bool:
        """Whether the frames hold YCbCr or RGB."""
        return self.matrix not in _LIGHTNESS_ONLY


def colours_of(frame: VideoFrame, container: tuple[int, int, int]) -> Colours:
    """Return the colours of a decoded frame; where it does not say, those of the container's tags.

    Without tags HDR is BT.2020, and SDR of 720 lines or 1280 columns on is BT.709, as players take it.
    """
    own = (frame.colorspace, frame.color_trc, frame.color_primaries)
    matrix, transfer, primaries = (
        theirs if ours in unknown else ours
        for ours, theirs, unknown in zip(own, container, (_UNKNOWN_MATRIX, _UNKNOWN, _UNKNOWN), strict=True)
    )
    if primaries in _UNKNOWN:
        primaries = _BT2020 if transfer in _PEAKS else _BT709
    if matrix in _UNKNOWN_MATRIX:
        is_hd = frame.height >= _HD_LINES or frame.width >= _HD_COLUMNS
        matrix = _BT2020 if transfer in _PEAKS else _BT709 if is_hd else None
    return Colours(matrix, transfer, primaries)


def tags(decoder: VideoCodecContext) -> tuple[int, int, int]:
    """Return the matrix, transfer and primaries that a container gives its decoder."""
    return decoder.colorspace, decoder.color_trc, decoder.color_primaries


def rgb_pixels(frame: VideoFrame, colours: Colours) -> np.ndarray:
    """Return the pixels of a frame as sRGB, uint8 [H, W, 3]. Raises what the decoder raises."""
    matrix = None if colours.matrix in (None, frame.colorspace) else _SWSCALE.get(colours.matrix, colours.matrix)
    if colours.is_plain and any(component.is_alpha for component in frame.format.components):
        clear = Image.fromarray(frame.to_ndarray(format="rgba", src_colorspace=matrix))
        on_white = Image.alpha_composite(Image.new("RGBA", clear.size, "white"), clear)  # as transparent pictures
        return np.array(on_white.convert("RGB"))
    if colours.is_plain:
        return frame.to_ndarray(format="rgb24", src_colorspace=matrix)
    return _to_srgb(frame.to_ndarray(format="rgb48le", src_colorspace=matrix), colours)


def srgb_of_coded(pixels: np.ndarray, transfer: int, primaries: int) -> tuple[np.ndarray, str]:
    """Return the pixels of an HDR picture, uint16 [H, W, 3], as sRGB in 8 bits, and what was done."""
    colours = Colours(None, transfer, _BT2020 if primaries in _UNKNOWN else primaries)
    return _to_srgb(pixels, colours), colours.note or ""


def _to_srgb(pixels: np.ndarray, colours: Colours) -> np.ndarray:
    """Return coded pixels, uint16 [H, W, 3], as sRGB in 8 bits: some rows at a time, which bounds the memory."""
    rows = max(1, _BAND // pixels.shape[1])
    return np.concatenate([_band(pixels[row : row + rows], colours) for row in range(0, len(pixels), rows)])


def _band(values: np.ndarray, colours: Colours) -> np.ndarray:
    light = _linear(colours.transfer)[values.reshape(-1, 3).T]  # [3, H * W]
    peak = np.float32(_PEAKS.get(colours.transfer, 1))
    if colours.transfer == _HLG:
        luminance = np.array(_XYZ.get(colours.primaries, _XYZ[_BT709])[1], np.float32) @ light
        light *= luminance ** np.float32(_HLG_GAMMA - 1) * peak
    if colours.primaries in WIDE:
        light = _to_bt709(colours.primaries) @ light
    if colours.transfer in _PEAKS:
        _roll_off(light, peak)
    steps = np.sqrt(light.clip(0, 1, out=light), out=light)
    steps *= np.float32(_STEPS - 1)
    steps += np.float32(0.5)
    return _srgb_codes()[steps.astype(np.uint16)].T.reshape(values.shape)


def _roll_off(light: np.ndarray, peak: np.float32) -> None:
    """Draw linear values [3, N] above the knee below 1, in place, by a curve without a bend that ends at the peak.

    All channels of a pixel are scaled by what its brightest one is, which keeps its hue.
    """
    knee = np.float32(_KNEE)
    brightest = np.maximum(np.maximum(light[0], light[1]), light[2])
    (bright,) = np.nonzero(brightest > knee)
    above = (brightest[bright] - knee) / (1 - knee)
    most = (peak - knee) / (1 - knee)
    shown = knee + (1 - knee) * above * (1 + above / most**2) / (1 + above)
    light[:, bright] *= shown / brightest[bright]


@functools.cache
def _linear(transfer: int) -> np.ndarray:
    """Return the light of every 16-bit code: of HLG the scene's in [0, 1], of others the display's, 1 being white."""
    codes = np.linspace(0, 1, _STEPS)
    if transfer == _HLG:  # BT.2100, inverse OETF
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        light = np.where(codes <= 0.5, codes**2 / 3, (np.exp((codes - c) / a) + b) / 12)
    elif transfer == _PQ:  # SMPTE ST 2084, EOTF
        m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
        root = codes ** (1 / m2)
        light = _PEAKS[_PQ] * (np.maximum(root - c1, 0) / (c2 - c3 * root)) ** (1 / m1)
    else:  # in and out by one curve: grey stays as it is
        light = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
    return light.astype(np.float32)


@functools.cache
def _to_bt709(primaries: int) -> np.ndarray:
    return np.linalg.solve(np.array(_XYZ[_BT709]), np.array(_XYZ[primaries])).astype(np.float32)


@functools.cache
def _srgb_codes() -> np.ndarray:
    """Return the sRGB, in 8 bits, of the squares of even steps from 0 to 1: even steps are too coarse in shadows."""
    light = np.linspace(0, 1, _STEPS) ** 2
    coded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.rint(255 * coded).astype(np.uint8)
