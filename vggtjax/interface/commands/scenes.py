"""The command `vggtjax scenes`. Does not import jax before it is needed."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from vggtjax.errors import InputError
from vggtjax.interface.commands.flags import InWords
from vggtjax.interface.commands.report import Report


@dataclass(frozen=True)
class Images:
    """How the images are drawn.

    Attributes:
        frames: frames of each scene, 1 to 1000.
        height: of the images, in pixels.
        width: of the images, in pixels.
        samples: rays per pixel along each side, averaged in the image; 1 to 8.
        shutter: share of the time between frames in which the shutter is open, for motion blur, from 0 to 1; above 0 it
            needs --exposures of at least 2.
        exposures: instants that motion blur averages over, 1 to 64; above 1 it needs a --shutter above 0.
    """

    frames: int = 24
    height: int = 240
    width: int = 320
    samples: int = 2
    shutter: float = 0.0
    exposures: int = 1


def scenes(
    out: Path,
    *,
    count: int = 8,
    images: Annotated[Images, tyro.conf.OmitArgPrefixes] = Images(),
    assets: InWords[Path | None] = None,
    kind: Literal["static", "dynamic"] = "dynamic",
    split: Literal["training", "test"] = "training",
    seed: int = 0,
) -> None:
    """Generate clips with exact depth, masks, parts, flow and cameras; `vggtjax evaluate plain` reads them.

    Args:
        out: folder of the set; existing scenes are kept, so the same command resumes an interrupted set.
        count: number of scenes.
        images: how the images are drawn.
        assets: folder of textures/, photos/ and objects/, for rooms, streets and landscapes of these instead of rooms
            of simple shapes; none by default.
        kind: "static", or "dynamic" where one to three objects move (of assets one to four), not always in view.
        split: of the textures, and of the assets; the two splits share no pixels of a photograph.
        seed: another seed draws other scenes.
    """
    report = Report()
    with report.running():
        with report.stage("prepare"):
            from vggtjax.training.scenes.config import SceneConfig
            from vggtjax.training.scenes.dataset import write_scenes

            config = SceneConfig(**asdict(images))
        with report.stage("generate") as progress:
            chosen = {"count": count, "kind": kind, "split": split, "seed": seed}
            if assets is not None and images != Images(images.frames, images.height, images.width):
                raise InputError("--samples, --shutter and --exposures are of rooms of simple shapes; leave them out")
            if assets is None:
                folders = write_scenes(out, config, **chosen, progress=progress)
            else:
                from vggtjax.training.world.dataset import write_worlds

                folders = write_worlds(out, assets, config, **chosen, progress=progress)
    report.table(
        {
            "scenes": f"{len(folders)} of {images.frames} frames of {images.width} x {images.height} pixels, {kind}",
            "first": f"{folders[0]}/",
            "index": out / "index.json",
            "preview": out / "preview.png",
        }
    )
