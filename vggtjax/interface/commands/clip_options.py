"""Masks and points of the user, as options of `vggtjax reconstruct`. Does not import jax before it is needed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from vggtjax.errors import InputError
from vggtjax.interface.commands.flags import InWords, Switch
from vggtjax.pipeline.batch.recipe import ClipRecipe
from vggtjax.pipeline.windows.plan import Windows


@dataclass(frozen=True)
class GivenInputs:
    """Masks and points of the user. Raises InputError for options that exclude each other.

    Attributes:
        masks: folder of mask pictures, one per frame and named like it (or with other names throughout, in the same
            order), white where something moves; by default masks are mined from the clip
        no_masks: treat the scene as static: no mask is mined and no second pass is run
        tracks: points to follow: grid:20 for 20 x 20 over the first frame, or a CSV file with columns x, y and
            optionally frame (counted from 0 among the frames that are taken; 0 by default), in pixels of the source;
            none by default
    """

    masks: InWords[Path | None] = None
    no_masks: Switch = False
    tracks: Annotated[str | None, tyro.conf.arg(metavar="GRID|FILE", help_behavior_hint="")] = None

    def __post_init__(self) -> None:
        if self.masks is not None and self.no_masks:
            raise InputError("--masks and --no-masks are opposites; give one of them")

    def check_one_shot(self) -> None:
        """Raise InputError for points to follow, which are points of one shot."""
        if self.tracks is not None:
            raise InputError(
                "--shots split and --tracks exclude each other: take one shot, by --start and --max-frames"
            )

    def check(self, recipe: ClipRecipe, windows: Windows) -> None:
        """Raise InputError for missing files, for options that need mined masks, and for those that exclude others."""
        for name, reason in recipe.needs_all_frames.items() if windows.window else ():
            raise InputError(f"{name} and --window exclude each other: {reason}")
        if self.tracks is not None and recipe.devices > 1:
            raise InputError("--devices and --tracks exclude each other: points are followed on one device")
        if self.masks is not None or self.no_masks:
            recipe.options.check_given_masks()
        if self.masks is not None:
            from vggtjax.clips.sources import open_source

            open_source(str(self.masks))
        if self.tracks is not None:
            from vggtjax.clips.queries import check_words

            check_words(self.tracks)
