"""The usual colour maps for pictures, viewers and files, mixed from 18 colours each: off by at most 4.3 %."""

from __future__ import annotations

from colorsys import hsv_to_rgb

import numpy as np
from jaxtyping import UInt8

_LEVELS = np.arange(256) / 255  # of sRGB
LINEAR = np.where(_LEVELS <= 0.04045, _LEVELS / 12.92, ((_LEVELS + 0.055) / 1.055) ** 2.4).astype(np.float32)

# Of matplotlib (CC0; turbo is by Google, Apache 2.0, RdBu by ColorBrewer, Apache 2.0).
_RAMPS = {
    "turbo": "30123b 3f3e9c 4666dd 458cfd 2fb2f4 1ad4d0 22ebaa 52fa7a 8bff4b "
    "b7f735 dbe236 f5c53a fea130 f9751d e84b0c ce2d04 a91601 7a0403",
    "inferno": "000004 0a0722 1e0c45 380962 510e6c 69166e 801f6c 982766 b0315b "
    "c63d4d d94d3d e9612b f47918 fa9407 fcb014 f8cd37 f2ea69 fcffa4",
    "viridis": "440154 481769 472a7a 433d84 3d4e8a 355e8d 2e6d8e 297b8e 23898e "
    "1f978b 21a585 2eb37c 46c06f 65cb5e 89d548 b0dd2f d8e219 fde725",
    "plasma": "0d0887 2f0596 4903a0 6100a7 7801a8 8e0ca4 a21d9a b42e8d c43e7f "
    "d24f71 de6164 e97257 f3854b f99a3e fdaf31 fdc627 f8df25 f0f921",
    "cividis": "00224e 002d68 163770 2e416d 3f4c6c 4e566c 5c616e 696b71 767676 "
    "838179 928c78 a09875 afa471 bfb06b cfbd62 dfca57 f0d846 fee838",
    "RdBu_r": "053061 15508d 276eb0 3b88be 5fa5cd 8dc2dc b3d6e8 d5e7f1 ecf2f5 "
    "f9efe9 fcdecd f9c2a7 f2a17f e17860 ce4f45 b82531 930e26 67001f",
}


def color_ramp(name: str, count: int = 256) -> UInt8[np.ndarray, "count 3"]:
    """Return the colours of a colour map from its first to its last."""
    colors = np.array([tuple(bytes.fromhex(color)) for color in _RAMPS[name].split()])
    places = np.linspace(0, len(colors) - 1, count)
    mixed = [np.interp(places, np.arange(len(colors)), channel) for channel in colors.T]
    return np.stack(mixed, axis=1).round().astype(np.uint8)


def hues(count: int) -> UInt8[np.ndarray, "count 3"]:
    """Return full colours around the circle, from red."""
    colors = [hsv_to_rgb(number / count, 1, 1) for number in range(count)]
    return (np.reshape(colors, (count, 3)) * 255).round().astype(np.uint8)
