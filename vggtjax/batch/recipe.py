"""What all clips of a batch have in common, and what becomes of each. Does not import jax."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from vggtjax.batch.destination import PAGE_NAME, SETTINGS_NAME
from vggtjax.clips.masks import masks_digest
from vggtjax.clips.preprocessing import Framing
from vggtjax.errors import InputError
from vggtjax.known.options import KnownGeometry
from vggtjax.media.sampling import Sampling
from vggtjax.options import Options
from vggtjax.results.saving import Saving
from vggtjax.storage.file_digest import file_digest

_TAKEN = ("", "..", SETTINGS_NAME, PAGE_NAME)

# By the name of a clip: an array, a folder of pictures, or False where nothing moves; or the folder of such folders.
# Masks of other clips are mined. False: nothing moves in any clip.
BatchMasks = Mapping[str, np.ndarray | str | Path | Literal[False] | None] | Path | Literal[False] | None


class ClipOutcome(NamedTuple):
    """The outcome of one clip of a batch."""

    name: str
    status: Literal["done", "kept", "failed"]  # kept: an earlier run has finished it
    reason: str = ""  # of a failure, or of windows
    frames: int = 0


@dataclass(frozen=True)
class Recipe:
    """How all clips of a batch are read, reconstructed and written."""

    options: Options = Options()
    framing: Framing = Framing()
    sampling: Sampling = Sampling()
    saving: Saving = Saving()
    known: KnownGeometry | None = None
    pad_frames: bool = False
    devices: int = 1
    unchecked: bool = False  # do not compare the memory that a clip needs with what is free
    masks: BatchMasks = None

    def masks_of(self, name: str) -> Any:
        """Return the masks of a clip, as `reconstruct` takes them; None where they are mined."""
        if not isinstance(self.masks, Path):
            return self.masks.get(name) if isinstance(self.masks, Mapping) else self.masks
        if not self.masks.is_dir():  # so it is on a worker that does not see the folder
            raise InputError(f"masks is {self.masks}, which is no folder here; expected a folder that all workers see")
        return folder if (folder := self.masks / name).is_dir() else None

    def check_masks(self, names: Collection[str]) -> None:
        """Raise InputError for masks of no clip, and for options of mined masks beside given ones."""
        if self.masks is None:
            return
        self.options.check_given_masks()
        if isinstance(self.masks, Path):
            if not any(self.masks_of(name) for name in names):
                raise InputError(
                    f"masks is {self.masks}; expected a folder with a folder of pictures named like a clip"
                )
        elif isinstance(self.masks, Mapping):
            if unknown := sorted(self.masks.keys() - set(names)):
                raise InputError(f"masks has {unknown[0]!r}, which is no clip of the batch; expected names of clips")
        elif self.masks is not False:
            raise InputError(
                f"masks is of type {type(self.masks).__name__}; expected masks by the name of the clip, a folder of "
                "folders, or False where nothing moves in any clip"
            )

    def masks_setting(self) -> dict[str, Any]:
        """Return what tells the masks of a batch from others, as JSON values; nothing where all are mined."""
        if self.masks is None:
            return {}
        if isinstance(self.masks, Path):
            return {"masks": f"{self.masks} {file_digest(sorted(self.masks.rglob('*')))}"}
        if isinstance(self.masks, Mapping):
            return {"masks": {name: masks_digest(masks) for name, masks in sorted(self.masks.items())}}
        return {"masks": "nothing moves"}


def failed(name: str, error: BaseException) -> ClipOutcome:
    """Return the outcome of a clip that an error ended."""
    return ClipOutcome(name, "failed", str(error) or "out of memory")


def invalid_name(name: str) -> ClipOutcome | None:
    """Return the failure of a clip whose name is no plain one, or is taken; None for other names."""
    if name not in _TAKEN and Path(name).name == name and name.isprintable():
        return None
    return ClipOutcome(name, "failed", f"a clip is named {name!r}; expected a plain name, which becomes its folder")
