"""How a result is written. Imports neither numpy nor jax: the command line takes its options from here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, TypedDict, get_args

from msgspec import Meta

from vggtjax.errors import InputError, check_choice
from vggtjax.storage.json_values import check_fields

Resolution = Literal["model", "original"]
Format = Literal["vggtjax", "vggt4d"]  # of a folder of files
# Of folders of other programs that are read.
ForeignFormat = Literal["vggt4d", "monst3r", "easi3r", "das3r", "pomato", "cut3r", "da3", "spatialtrackerv2"]
ReadFormat = Literal["vggtjax", ForeignFormat]
READ_FORMATS: tuple[ReadFormat, ...] = get_args(ReadFormat)
Group = Literal["depth", "confidence", "cameras", "masks", "previews", "clouds", "scene", "report"]

# Files and folders of a result by group, beside the archive, which every result has.
GROUPS: dict[Group, tuple[str, ...]] = {
    "depth": ("depth",),
    "confidence": ("confidence",),
    "cameras": ("trajectory.txt", "intrinsics.txt"),
    "masks": ("mask", "instances"),
    "previews": ("preview",),
    "clouds": ("static.ply", "frames"),
    "scene": ("scene.glb",),
    "report": ("report.html",),
}
NAMES = tuple(name for names in GROUPS.values() for name in names)
OPTIONAL_FILES = ("tracks.npz", "vggt4d")  # written where points were tracked; for the format vggt4d


def parse_groups(text: str) -> tuple[Group, ...]:
    """Return the groups that a text names, such as "depth,cameras", each once. Raises InputError for unknown names."""
    names = dict.fromkeys(name.strip() for name in text.split(",") if name.strip())
    for name in names:
        check_choice("only", name, get_args(Group))
    return tuple(group for group in GROUPS if group in names)


@dataclass(frozen=True)
class Saving:
    """How a result is written. Raises InputError for a percentile outside [0, 100) or an unknown name.

    Attributes:
        confidence_percentile: leave out this percentage of the pixels, those of the lowest confidence, from the point
            clouds; at least 0 and less than 100
        resolution: size of the written files: model, or original, the source's own, with crop, scale and padding undone
        format: the program whose files the folder has: vggtjax; or vggt4d, with its files in vggt4d/ beside ours
        only: write only these groups of files: depth, confidence, cameras, masks, previews, clouds, scene, report; all
            by default. The archive, reconstruction.npz, is always written: vggtjax reads everything from it
    """

    confidence_percentile: Annotated[float, Meta(ge=0, lt=100)] = 20.0
    resolution: Resolution = "model"
    format: Format = "vggtjax"
    only: tuple[Group, ...] | None = None

    def __post_init__(self) -> None:
        if isinstance(self.only, str):
            raise InputError(f"only is {self.only!r}; expected a tuple of groups, such as ('depth', 'cameras')")
        check_fields(self)

    def writes(self, group: Group) -> bool:
        """Return whether the files of a group are written."""
        return self.only is None or group in self.only

    def names(self, *, tracks: bool) -> tuple[str, ...]:
        """Return the files and folders that are written beside the archive, with points tracked or without."""
        optional = zip(OPTIONAL_FILES, (tracks, self.format == "vggt4d"), strict=True)
        groups = (name for group, names in GROUPS.items() if self.writes(group) for name in names)
        return (*groups, *(name for name, is_written in optional if is_written))


class SavingChanges(TypedDict, total=False):
    """Keywords of `Reconstruction.save` that change single values of its `saving`."""

    confidence_percentile: float
    resolution: Resolution
    format: Format
    only: tuple[Group, ...] | None
