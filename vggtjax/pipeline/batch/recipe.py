"""The settings of a clip and of a batch, which are also the options of commands, and the outcome of a clip.

Does not import jax.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Generator, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

import numpy as np

from vggtjax.clips.masks import masks_digest
from vggtjax.clips.media.sampling import Sampling
from vggtjax.clips.preprocessing import Framing
from vggtjax.errors import InputError, reading, whole_number
from vggtjax.options import Options
from vggtjax.pipeline.batch.destination import PAGE_NAME, SETTINGS_NAME
from vggtjax.pipeline.known.options import KnownGeometry
from vggtjax.progress import Progress
from vggtjax.results.saving import Saving
from vggtjax.storage.file_digest import file_digest

CHANGED = "its source has changed since the earlier result"
_TAKEN = ("", "..", SETTINGS_NAME, PAGE_NAME)

# By the name of a clip: an array, a folder of pictures, or False where nothing moves; or the folder of such folders.
# Masks of other clips are mined. False: nothing moves in any clip.
BatchMasks = Mapping[str, np.ndarray | str | Path | Literal[False] | None] | str | Path | Literal[False] | None


class ClipOutcome(NamedTuple):
    """The outcome of one clip of a batch."""

    name: str
    status: Literal["done", "kept", "failed"]  # kept: an earlier run has finished it
    reason: str = ""  # of a failure, of windows, or of doing it again
    frames: int = 0

    def of_changed(self) -> ClipOutcome:
        """Return the outcome of a clip that was done again as its source has changed."""
        return self._replace(reason=f"{CHANGED}; {self.reason}".rstrip("; ")) if self.status == "done" else self


@dataclass(frozen=True)
class ClipRecipe:
    """How a clip is read, reconstructed and written."""

    sampling: Sampling = Sampling()
    framing: Framing = Framing()
    undistort: bool = True
    options: Options = Options()
    devices: int = 1
    known: KnownGeometry = KnownGeometry()
    unchecked: bool = False  # do not compare the memory that a clip needs with what is free
    saving: Saving = Saving()

    @property
    def needs_all_frames(self) -> dict[str, str]:
        """The given options that need all frames at once, so that a clip is not run in windows, and why."""
        needs = {
            "--devices": (self.devices > 1, "a window is run on one device"),
            "known cameras or lengths": (self.known, "they are brought into a clip that is run as a whole"),
            "--refine-cameras": (self.options.refine_cameras, "cameras are adjusted over all frames"),
        }
        return {name: reason for name, (given, reason) in needs.items() if given}

    def changed(self, **changes: Any) -> Self:
        """Return the recipe with other values, by the names of its fields or of fields of its parts, such as `fps`.

        None for a part is its default. Raises TypeError for an unknown name, and for a part of another type.
        """
        values = {field.name: changes.pop(field.name) for field in dataclasses.fields(self) if field.name in changes}
        for part in ("sampling", "framing", "saving", "options", "known"):
            kind = type(getattr(self, part))
            if values.get(part, 0) is None:
                values[part] = kind()
            elif not isinstance(values.get(part, getattr(self, part)), kind):
                raise TypeError(f"{part} is of type {type(values[part]).__name__}; expected {kind.__name__}")
        for part in ("sampling", "framing", "saving", "options"):
            value = values.get(part, getattr(self, part))
            names = [field.name for field in dataclasses.fields(value) if field.name in changes]
            values[part] = dataclasses.replace(value, **{name: changes.pop(name) for name in names})
        if changes:
            parts = [self, self.sampling, self.framing, self.saving, self.options]
            names = sorted({field.name for part in parts for field in dataclasses.fields(part)})
            raise TypeError(f"no option is named {' or '.join(sorted(changes))}; expected some of {names}")
        return dataclasses.replace(self, **values)


@dataclass(frozen=True)
class BatchRecipe(ClipRecipe):
    """How all clips of a batch are read, reconstructed and written."""

    pad_frames: bool = False
    masks: BatchMasks = None

    def __post_init__(self) -> None:
        if isinstance(self.masks, str):
            object.__setattr__(self, "masks", Path(self.masks))
        elif isinstance(self.masks, Mapping) and not self.masks:
            object.__setattr__(self, "masks", None)

    def check(self, names: Collection[str]) -> None:
        """Raise InputError for what cannot be done for clips of these names."""
        from vggtjax.pipeline.known.given import check_readable
        from vggtjax.pipeline.refinement.refine import check_refinement

        whole_number("devices", self.devices, 1)
        self.known.check_many()
        check_readable(self.known)
        check_refinement(self.options.refine_cameras, self.known.poses is not None)
        self._check_masks(names)

    def masks_of(self, name: str) -> Any:
        """Return the masks of a clip, as `reconstruct` takes them; None where they are mined."""
        if not isinstance(self.masks, Path):
            return self.masks.get(name) if isinstance(self.masks, Mapping) else self.masks
        if not self.masks.is_dir():  # so it is on a worker that does not see the folder
            raise InputError(f"masks is {self.masks}, which is no folder here; expected a folder that all workers see")
        return folder if (folder := self.masks / name).is_dir() else None

    def _check_masks(self, names: Collection[str]) -> None:
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
            with reading(self.masks):
                return {"masks": f"{self.masks} {file_digest(sorted(self.masks.rglob('*')))}"}
        if isinstance(self.masks, Mapping):
            return {"masks": {name: masks_digest(masks) for name, masks in sorted(self.masks.items())}}
        return {"masks": "nothing moves"}


def counted(outcomes: Iterable[ClipOutcome], total: int, progress: Progress) -> Generator[ClipOutcome]:
    """Yield outcomes; tell the number of computed clips, and of all but kept and failed ones."""
    done = 0
    progress(done, total)
    for outcome in outcomes:
        done += outcome.status == "done"
        total -= outcome.status != "done"
        progress(done, total)
        yield outcome


def failed(name: str, error: BaseException) -> ClipOutcome:
    """Return the outcome of a clip that an error ended."""
    return ClipOutcome(name, "failed", str(error) or "out of memory")


def invalid_name(name: str) -> ClipOutcome | None:
    """Return the failure of a clip whose name is no plain one, or is taken; None for other names."""
    if name not in _TAKEN and Path(name).name == name and name.isprintable():
        return None
    return ClipOutcome(name, "failed", f"a clip is named {name!r}; expected a plain name, which becomes its folder")
