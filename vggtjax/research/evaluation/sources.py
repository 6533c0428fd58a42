"""Where the results of an evaluation come from: a model that runs, or folders that other programs wrote."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vggtjax.clips.captures.pictures import picture_size
from vggtjax.clips.preprocessing import Framing
from vggtjax.errors import InputError
from vggtjax.options import METHODS, Options
from vggtjax.progress import OnStage
from vggtjax.research.evaluation.datasets.sequence import LabelledSequence
from vggtjax.research.evaluation.foreign_frames import placed
from vggtjax.research.evaluation.records import shown_name
from vggtjax.results.foreign import check_format, needs_quaternion
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.storage.file_digest import file_digest
from vggtjax.storage.trajectories import Quaternion

if TYPE_CHECKING:  # the folders of other programs are scored without jax
    from vggtjax.clips.clip import Clip
    from vggtjax.method.fusion.family import FusionParams
    from vggtjax.network.checkpoint import Model

_MOST_FILES = 100_000  # of a folder with one result


@dataclass
class ModelSource:
    """Results of a model by several methods; methods with the same masks share one run of the passes.

    Raises:
        InputError: an unknown method, a fusion though no method fuses, or a size that is no multiple of the patch size.
    """

    model: Model
    names: Sequence[str]  # of `METHODS`
    options: Options = Options()  # of all methods; `options.method` is not read
    framing: Framing = Framing()
    fusion: FusionParams | None = None
    groups: Sequence[Sequence[str]] = field(init=False)
    _last: tuple[LabelledSequence, Clip] | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        from vggtjax.method.assembly import check_fuses
        from vggtjax.pipeline.several import groups_of_methods

        check_fuses(self.fusion, *self.names)
        config = self.model.config
        self._fitter = self.framing.fitter(config)
        groups = groups_of_methods(self.names, self.options, config.motion)
        self.groups = [[each.method for each in group] for group in groups]

    @property
    def settings(self) -> dict[str, Any]:
        """What the results depend on besides the sequence, as JSON values."""
        settings = {"model": self.model.identity.to_json(), "mode": self._fitter.mode, "size": self._fitter.size}
        settings |= {"model_note": self.model.note} if self.model.note else {}
        settings |= {name: value for name, value in self.options.to_json().items() if name != "method"}
        settings["mask_pairs"] = self.options.resolved(self.model.config.motion).mask_pairs
        if (threshold := self.options.threshold or self.model.config.motion.threshold) is not None:
            settings["threshold"] = threshold  # `to_json` leaves out a method's own
        if self.options.mask is not None:
            settings["mask"] = self.options.mask
        if self.fusion is not None:
            from vggtjax.method.fusion.file import fusion_digest

            settings["fusion"] = fusion_digest(self.fusion)
        return settings

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences that a reader of the numbers must know."""
        return (self.model.warning,) if self.model.note else ()

    def fingerprint(self, name: str, sequence: LabelledSequence) -> str:
        """Return "": a model's results depend on the settings and the sequence alone."""
        del name, sequence
        return ""

    def results(
        self, names: Sequence[str], sequence: LabelledSequence, on_stage: OnStage
    ) -> Mapping[str, Reconstruction]:
        """Return the results of one group; the groups of a sequence share its clip."""
        from vggtjax.clips.clip import read_clip
        from vggtjax.clips.media.sampling import Sampling
        from vggtjax.clips.sources import open_source
        from vggtjax.pipeline.several import reconstruct_methods

        if self._last is None or self._last[0] is not sequence:
            paths = [str(path) for path in sequence.pictures]
            self._last = sequence, read_clip(open_source(paths), Sampling(), self._fitter)
        _, clip = self._last
        fusion = self.fusion if any(METHODS[name].depth == "fused" for name in names) else None
        return reconstruct_methods(
            self.model, clip, names, options=self.options, size=self._fitter.size, fusion=fusion, on_stage=on_stage
        )


@dataclass(frozen=True)
class FolderSource:
    """Results in folders: `folders[name] / sequence` holds one result, or is its one file, SEQUENCE.npz.

    Raises:
        InputError: a name that is not printable or too long, or an order of quaternions that a format lacks, or that no
            format needs.
    """

    folders: Mapping[str, Path]
    formats: Mapping[str, str] = field(default_factory=dict)  # by name, of the program that wrote it; else "vggtjax"
    quaternion: Quaternion | None = None  # of the formats that need one
    strict: bool = False  # refuse results of other frames than all of a sequence's
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        formats = [self._format(name) for name in self.folders]
        for form in formats:
            check_format(form, self.quaternion if needs_quaternion(form) else None)
        if self.quaternion is not None and not any(map(needs_quaternion, formats)):
            check_format(next(iter(formats), "vggtjax"), self.quaternion)
        if wrong := [name for name in self.folders if shown_name(name) != name]:
            raise InputError(f"results cannot be named {shown_name(wrong[0])}; expected a short printable name")

    @property
    def names(self) -> Sequence[str]:
        return tuple(self.folders)

    @property
    def groups(self) -> Sequence[Sequence[str]]:
        return tuple((name,) for name in self.folders)

    @property
    def settings(self) -> dict[str, Any]:
        """What the numbers depend on besides the files, as JSON values."""
        return {"formats": {name: self._format(name) for name in self.folders}, "quaternion": self.quaternion}

    def _format(self, name: str) -> str:
        return self.formats.get(name, "vggtjax")

    def _path(self, name: str, sequence: LabelledSequence) -> Path:
        folder = self.folders[name] / sequence.name
        file = folder.with_name(f"{folder.name}.npz")
        return file if file.is_file() and not folder.exists() else folder

    def fingerprint(self, name: str, sequence: LabelledSequence) -> str:
        """Return a digest of the names, sizes and dates of the result's files; "" where there are none."""
        folder = self._path(name, sequence)
        try:
            paths = list(islice(folder.rglob("*"), _MOST_FILES + 1)) if folder.is_dir() else [folder]
            if len(paths) > _MOST_FILES:
                raise InputError(f"{folder} holds more than {_MOST_FILES} files; expected one result")
            return file_digest(sorted(paths))
        except OSError:
            return ""

    def results(
        self, names: Sequence[str], sequence: LabelledSequence, on_stage: OnStage
    ) -> Mapping[str, Reconstruction]:
        """Load the results of one group, and place their frames in the sequence's pictures."""
        del on_stage
        sizes = [picture_size(path) for path in sequence.pictures]
        results = {}
        for name in names:
            form = self._format(name)
            quaternion = self.quaternion if needs_quaternion(form) else None
            result = Reconstruction.load(self._path(name, sequence), format=form, quaternion=quaternion)
            results[name] = placed(result, form, sizes, sequence.frame_names, sequence.timestamps, strict=self.strict)
        return results


ResultSource = ModelSource | FolderSource
"""What `evaluate` scores: results by name for each sequence; the results of one group are computed together."""
