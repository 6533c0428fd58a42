"""What to do with pixels that move: errors of cameras and static depth, when they are painted over or suppressed."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, UInt8

from benchmarks.held_out import held_out_truth
from vggtjax.clips.media.arrays import in_bytes
from vggtjax.clips.truth import Truth
from vggtjax.errors import InputError
from vggtjax.pipeline.pretrained.load import load_model
from vggtjax.pipeline.run import reconstruct
from vggtjax.research.evaluation.metrics.depth import depth_errors, measured, median_scale
from vggtjax.research.evaluation.metrics.trajectory import centre_error, rotation_error
from vggtjax.storage.markdown import markdown_table
from vggtjax.training.scenes import SceneConfig

Image: TypeAlias = UInt8[np.ndarray, "H W 3"]
Mask: TypeAlias = Bool[np.ndarray, "H W"]
_METRICS = ("rotation (deg)", "centres", "AbsRel static")
_AROUND = 5  # pixels around a hole that OpenCV looks at


def _inpainted(image: Image, mask: Mask) -> Image:
    import cv2  # pyright: ignore[reportMissingImports]

    return cv2.inpaint(np.ascontiguousarray(image), mask.astype(np.uint8), _AROUND, cv2.INPAINT_TELEA)


def _filled(value: Callable[[Image, Mask], object]) -> Callable[[Image, Mask], Image]:
    return lambda image, mask: np.where(mask[..., None], np.asarray(value(image, mask)), image).astype(np.uint8)


FILLS: dict[str, Callable[[Image, Mask], Image]] = {
    "nothing is done": lambda image, mask: image,
    "black": _filled(lambda image, mask: 0),
    "grey": _filled(lambda image, mask: 128),
    "mean colour": _filled(lambda image, mask: image[~mask].mean(axis=0) if not mask.all() else 128),
    "inpainted (OpenCV)": _inpainted,
}


def masked_pixels(*, model: str = "demo", clips: int = 64, frames: int = 12, side: int = 96, seed: int = 0) -> None:
    """Print errors of one pass over pictures whose moving pixels are painted over, and of the pass that ignores them.

    All use the same true masks. The last row is the second pass of the method pose-decoupling. Needs OpenCV: pip
    install opencv-python-headless.

    Args:
        model: "demo", or weights as for vggtjax reconstruct.
        clips: held-out generated scenes with movers, at least 2.
        frames: of a clip.
        side: of the frames, in pixels.
        seed: of the scenes.
    """
    if clips < 2:
        raise InputError(f"clips is {clips}; expected at least 2")
    try:
        import cv2  # noqa: F401 # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise InputError("inpainting needs OpenCV: pip install opencv-python-headless") from error
    logging.disable(logging.WARNING)
    network, ways = load_model(model), [*FILLS, "keys suppressed (this method)"]
    scenes = held_out_truth("dynamic", clips, SceneConfig(height=side, width=side, frames=frames), seed=seed)
    errors = np.zeros((len(ways), clips, len(_METRICS)))
    for number in range(clips):
        truth = scenes.clip(number)
        images = in_bytes(truth.images)
        for row, fill in enumerate(FILLS.values()):
            painted = np.stack([fill(*each) for each in zip(images, truth.dynamic_mask, strict=True)])
            errors[row, number] = _errors(reconstruct(network, painted, method="vggt"), truth)
        suppressed = reconstruct(network, images, method="pose-decoupling", masks=truth.dynamic_mask)
        errors[-1, number] = _errors(suppressed, truth)
        sys.stderr.write(f"\r{number + 1} of {clips}")
    first = errors[0]
    rows = []
    for way, found in zip(ways, errors, strict=True):
        change = (found - first).mean(axis=0) / first.mean(axis=0)
        error = (found - first).std(axis=0, ddof=1) / clips**0.5 / first.mean(axis=0)
        cells = [f"{mean:.4f}" for mean in found.mean(axis=0)]
        if found is not first and way != ways[0]:
            cells = [f"{c} ({d:+.1%} ± {e:.1%})" for c, d, e in zip(cells, change, error, strict=True)]
        rows.append([way, *cells])
    sys.stdout.write("\n" + markdown_table([f"{clips} clips", *_METRICS], rows))


def _errors(result, truth: Truth) -> tuple[float, float, float]:
    poses, true = (x.camera_from_world.astype(np.float64) for x in (result, truth))
    depth = np.where(truth.dynamic_mask, 0, truth.depth)  # of what stands still
    still = depth_errors(result.depth, depth, measured(depth), scale=median_scale(result.depth, depth))
    return rotation_error(poses, true), centre_error(poses, true), still.abs_rel
