"""Options of `vggtjax reconstruct` in groups of their own. Does not import jax before it is needed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from vggtjax.errors import InputError
from vggtjax.known.options import KnownGeometry
from vggtjax.options import Options
from vggtjax.storage.flags import InWords, Switch
from vggtjax.windows.plan import Windows

if TYPE_CHECKING:
    import numpy as np

    from vggtjax.clips.clip import Clip

_NOTHING_KNOWN = KnownGeometry()


@dataclass(frozen=True)
class ExtraOptions:
    """Options in groups of their own. Raises InputError for options that exclude each other."""

    geometry: Annotated[KnownGeometry, tyro.conf.arg(name="known cameras and scale", help="")] = _NOTHING_KNOWN
    windows: Annotated[Windows, tyro.conf.arg(name="long clip", help="")] = Windows()

    def __post_init__(self) -> None:
        if self.windows.window and self.geometry:
            raise InputError(
                "known cameras or lengths and --window exclude each other: they are brought into a clip "
                "that is run as a whole"
            )


@dataclass(frozen=True)
class GivenInputs:
    """Masks and points of the user. Raises InputError for options that exclude each other."""

    masks: InWords[Path | None] = None
    """folder of pictures, one per frame, bright where something moves; mined from the clip by default"""
    no_masks: Switch = False
    """nothing moves: one pass is enough"""
    tracks: Annotated[str | None, tyro.conf.arg(metavar="GRID|FILE", help_behavior_hint="")] = None
    """points to follow: grid:20 for 20 x 20 over the first frame, or a CSV file with columns x, y and, if wanted,
    frame, in pixels of the source; none by default"""

    def __post_init__(self) -> None:
        if self.masks is not None and self.no_masks:
            raise InputError("--masks and --no-masks are opposites; give one of them")

    def check(self, options: Options, windows: Windows) -> None:
        """Raise InputError for missing files, for options that need mined masks, or all frames at once."""
        if options.refine_cameras and windows.window:
            raise InputError("--refine-cameras and --window exclude each other: cameras are adjusted over all frames")
        if self.masks is not None or self.no_masks:
            options.check_given_masks()
        if self.masks is not None:
            from vggtjax.clips.sources import open_source

            open_source(str(self.masks))
        if self.tracks is not None:
            from vggtjax.clips.queries import check_words

            check_words(self.tracks)

    def masks_of(self, clip: Clip) -> np.ndarray | None:
        """Return the masks at the clip's frames, or None where they are mined."""
        import numpy as np

        from vggtjax.clips.masks import load_masks

        if self.no_masks:
            return np.zeros(clip.images.shape[:3], bool)
        return None if self.masks is None else load_masks(self.masks, clip)
