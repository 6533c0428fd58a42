"""Time of mask refinement: python -m benchmarks refinement."""

from __future__ import annotations

import time

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from vggtjax.cameras import unproject
from vggtjax.errors import InputError
from vggtjax.method.mask_refinement import refine_masks, statistical_outliers
from vggtjax.scenes import load_textures
from vggtjax.scenes.config import SceneConfig
from vggtjax.scenes.render import generate


def refinement(*, frames: int = 32, height: int = 294, width: int = 518, grow: int = 12, repeats: int = 3) -> None:
    """Time mask refinement on a generated clip with an enlarged true mask.

    Args:
        frames: frames of the clip.
        height: of a frame, in pixels.
        width: of a frame, in pixels.
        grow: pixels added to the true mask on every side.
        repeats: runs after the one with compilation.
    """
    from scipy.ndimage import binary_dilation

    for name, value in (("grow", grow), ("repeats", repeats)):
        if value < 1:
            raise InputError(f"{name} is {value}; expected at least 1")
    config = SceneConfig(height=height, width=width, frames=frames, dynamic=1.0, static_camera=0.0)
    clip = jax.tree.map(
        np.asarray, jax.jit(generate, static_argnums=2)(jax.random.key(0), load_textures("test"), config)
    )
    unit = np.median(clip.depth)
    pose = np.concatenate([clip.camera_from_world[..., :3], clip.camera_from_world[..., 3:] / unit], axis=-1)
    mask = np.stack([binary_dilation(one, iterations=grow) for one in clip.dynamic_mask])
    scene = (clip.images, clip.depth / unit, mask, pose, clip.intrinsics)

    def timed() -> float:
        began = time.perf_counter()
        refine_masks(*scene)
        return time.perf_counter() - began

    first, *later = (timed() for _ in range(1 + repeats))
    points = unproject(scene[1], clip.intrinsics, pose, pixel_offset=0.5)
    began = time.perf_counter()
    for frame in points:
        statistical_outliers(frame)
    outliers = time.perf_counter() - began
    refined = refine_masks(*scene)
    table = Table(title=f"{frames} frames of {width} x {height}, mask on {mask.mean():.1%} of the pixels", box=None)
    for heading in ("", "seconds"):
        table.add_column(heading, justify="left" if not heading else "right")
    table.add_row("first run, with compilation", f"{first:.1f}")
    table.add_row(f"median of {repeats}", f"{np.median(later):.1f}")
    table.add_row("of which outliers", f"{outliers:.1f}")
    console = Console()
    console.print(table)
    for name, made in (("coarse", mask), ("refined", refined)):
        overlap = (made & clip.dynamic_mask).sum() / (made | clip.dynamic_mask).sum()
        console.print(f"IoU of the {name} mask with the true one: {overlap:.3f}", highlight=False)
