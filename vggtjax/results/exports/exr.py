"""Depth and confidence as OpenEXR files, for compositing programs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from vggtjax.results.colors import LINEAR
from vggtjax.results.exports.views import View, placed


def write_exr(folder: Path, items: Iterator[View]) -> None:
    """Write NAME.exr per frame into an empty folder: float32 channels R, G, B (linear), Z, confidence, moving.

    Z is the depth along the optical axis, in units of the result, 0 where unknown. moving is 1 where the world moves;
    results without a mask lack it.
    """
    import OpenEXR

    for view in items:
        frame = view.frame
        channels = {name: LINEAR[frame.image[..., index]] for index, name in enumerate("RGB")}
        channels["Z"] = np.where(frame.valid, frame.depth, 0).astype(np.float32)
        channels["confidence"] = frame.confidence.astype(np.float32)
        if view.has_mask:
            channels["moving"] = frame.dynamic_mask.astype(np.float32)
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, channels).write(str(placed(folder, f"{Path(view.name).with_suffix('')}.exr")))
