"""What all clips of a batch have in common, and what becomes of each. Does not import jax."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from vggtjax.clips.preprocessing import Framing
from vggtjax.clips.sampling import Sampling
from vggtjax.known.options import KnownGeometry
from vggtjax.options import Options
from vggtjax.pipeline.destination import PAGE_NAME, SETTINGS_NAME
from vggtjax.results.saving import Saving

_TAKEN = ("", "..", SETTINGS_NAME, PAGE_NAME)


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


def failed(name: str, error: BaseException) -> ClipOutcome:
    """Return the outcome of a clip that an error ended."""
    return ClipOutcome(name, "failed", str(error) or "out of memory")


def odd_name(name: str) -> ClipOutcome | None:
    """Return the failure of a clip whose name is no plain one, or is taken; None for other names."""
    if name not in _TAKEN and Path(name).name == name and name.isprintable():
        return None
    return ClipOutcome(name, "failed", f"a clip is named {name!r}; expected a plain name, which becomes its folder")
