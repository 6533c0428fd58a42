"""How a result is written. Imports neither numpy nor jax: the command line takes its options from here."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal, TypedDict

from msgspec import Meta

from vggtjax.storage.json_values import check_fields

Resolution = Literal["model", "original"]
Format = Literal["vggtjax", "vggt4d"]  # of a folder of files


@dataclass(frozen=True)
class Saving:
    """How a result is written. Raises InputError for a percentile outside [0, 100) or an unknown name."""

    confidence_percentile: Annotated[float, Meta(ge=0, lt=100)] = 20.0
    """percent of the pixels, the least confident, to leave out of the point clouds"""
    resolution: Resolution = "model"
    """size of the written files: the model's, or the source's own, with crop, scale and padding undone"""
    format: Format = "vggtjax"
    """"vggt4d" writes, beside the files of vggtjax, the folder vggt4d/ as VGGT4D does"""

    def __post_init__(self) -> None:
        check_fields(self)

    def changed(self, *, layout: Format | None = None, **changes: object) -> Saving:
        """Return a copy with other values; `layout` is the old name of `format`."""
        return replace(self, **changes, **({} if layout is None else {"format": layout}))  # pyright: ignore[reportArgumentType]


class SavingChanges(TypedDict, total=False):
    """Keywords of `Reconstruction.save` that change single values of its `saving`."""

    confidence_percentile: float
    resolution: Resolution
    format: Format
    layout: Format
