"""The command `vggtjax scenes`. Does not import jax before it is needed."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from vggtjax.commands.report import Report


def scenes(
    out: Path,
    *,
    count: int = 8,
    frames: int = 24,
    height: int = 240,
    width: int = 320,
    kind: Literal["static", "dynamic"] = "dynamic",
    split: Literal["training", "test"] = "training",
    seed: int = 0,
    samples: int = 2,
    shutter: float = 0.0,
    exposures: int = 1,
) -> None:
    """Generate clips of rooms with exact depth, masks, parts, flow and cameras, as a data set.

    Args:
        out: folder for the set; scenes that are there already are kept, and the same command goes on.
        count: number of scenes.
        frames: of each scene.
        height: of the images, in pixels.
        width: of the images, in pixels.
        kind: "static", or "dynamic" where one to three things move, which the camera need not see.
        split: of the textures; the two share no photograph's pixels.
        seed: another seed draws other scenes.
        samples: rays per pixel along each side, averaged in the image.
        shutter: share of the time between frames that the shutter is open, for motion blur; needs exposures.
        exposures: instants that motion blur averages over.
    """
    report = Report()
    with report.running():
        with report.stage("prepare"):
            from vggtjax.scenes.dataset import write_scenes
            from vggtjax.scenes.scene import SceneConfig

            config = SceneConfig(
                height=height, width=width, frames=frames, samples=samples, shutter=shutter, exposures=exposures
            )
        with report.stage("generate") as progress:
            written = write_scenes(out, config, count=count, kind=kind, split=split, seed=seed, progress=progress)
    report.table(
        {
            "scenes": f"{len(written)} of {frames} frames of {width} x {height} pixels, {kind}",
            "first": f"{written[0]}/",
            "what is what": out / "index.json",
            "look at": out / "preview.png",
        }
    )
