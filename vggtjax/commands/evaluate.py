"""What `vggtjax evaluate` does: methods, or results of other programs, on the sequences of a data set."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from vggtjax.commands.report import Report
from vggtjax.errors import InputError

if TYPE_CHECKING:
    from vggtjax.checkpoint import Model
    from vggtjax.clips.clip import Clip
    from vggtjax.evaluation.datasets.sequence import Sequence as Frames
    from vggtjax.evaluation.run import OnStage
    from vggtjax.results.reconstruction import Reconstruction

_LADDER = "vggt,vggt4d,pose-decoupling,hard-replacement,4dvggt-d"
_UNTRAINED = "The weights of this model are untrained: these numbers show that everything runs, and mean nothing else."


def evaluate(
    dataset: tyro.conf.Positional[str],
    root: tyro.conf.Positional[Path],
    /,
    out: Path,
    *,
    model: str | None = None,
    methods: str | None = None,
    results: tuple[str, ...] = (),
    layout: Annotated[
        Literal["vggtjax", "vggt4d", "monst3r", "cut3r", "da3"] | None, tyro.conf.arg(name="format")
    ] = None,
    quaternion: Literal["xyzw", "wxyz"] | None = None,
    sequences: str | None = None,
    stride: int | None = None,
    max_frames: int | None = None,
    gt: str | None = None,
    depth_align: Literal["metric", "median", "scale", "scale-shift"] = "scale",
    empty: Literal["davis", "vggt4d"] = "davis",
    mode: Literal["crop", "pad"] = "crop",
    size: int | None = None,
    mask_pairs: int = 5,
    align_scale: bool = False,
    smooth_frames: int = 1,
    fusion: Path | None = None,
    dtype: Literal["float32", "bfloat16"] = "float32",
) -> None:
    """Score methods on a data set with ground truth: cameras, point clouds, masks, depth, uncertainty.

    Sequences that are finished are kept: the same command goes on where it was interrupted.

    Args:
        dataset: its name: composite, hololens, plain, tum, bonn, dycheck, sintel, kitti, davis, davis-2017 or 7scenes.
        root: folder of the data set, or of one sequence of it.
        out: folder for results.json, results.csv, table.md, table.tex and index.html.
        model: "demo" (the default), a converted .safetensors, a PyTorch checkpoint, or a hub id.
        methods: names of methods, with commas; all five by default. Those that mine alike share one run of the passes.
        results: score results in these folders instead, NAME=FOLDER, each with a folder for every sequence; no model
            is run.
        layout: of those, by the program that wrote them; vggtjax by default.
        quaternion: order of quaternions in their pred_traj.txt: wxyz as MonST3R and VGGT4D write it, or xyzw.
        sequences: names, with commas; those of the published protocol, or all, by default.
        stride: take every stride-th frame; the published protocol's own by default, whose window or cap stays.
        max_frames: take so many frames at most.
        gt: ground truth to use, where a data set has several: for dycheck easi3r or lidar.
        depth_align: how video depth is brought to metres.
        empty: J of a frame in which nothing moves and nothing is found: 1 (davis) or 0 (vggt4d).
        mode: how frames are fitted to the model: crop or pad.
        size: side in pixels to run at; the model's own by default.
        mask_pairs: number of pairs in which the keys of dynamic tokens are suppressed.
        align_scale: bring the second pass to the first one's scale before fusing (not in the paper).
        smooth_frames: odd number of frames that the saliency is averaged over (not in the papers).
        fusion: file of a fitted rule of fusion, as vggtjax fit-fusion writes it; the paper's rule by default.
        dtype: of the blocks' matrix products.
    """
    report = Report()
    with report.running():
        from vggtjax.evaluation.datasets import DATASETS, find_sequences
        from vggtjax.evaluation.page import NAMES, check_extras, is_report, write_report
        from vggtjax.evaluation.records import FOLDER, Records, summary
        from vggtjax.evaluation.run import Scoring
        from vggtjax.evaluation.run import evaluate as run
        from vggtjax.storage.writing import check_free

        check_extras()
        store = Records(out)
        check_free(
            out, (*NAMES, FOLDER), replaced=is_report(out / "results.json") or store.is_there(), what="evaluation"
        )
        if max_frames is not None and max_frames < 1:
            raise InputError(f"--max-frames is {max_frames}; expected at least 1")
        folders = _folders(results, model, methods, layout, quaternion)
        names = _method_names(methods or _LADDER)
        with report.stage("open data set"):
            chosen = None if sequences is None else tuple(name.strip() for name in sequences.split(","))
            found = find_sequences(dataset, root, sequences=chosen, stride=stride, gt=gt)
            if max_frames is not None:
                found = {name: _first(opener, max_frames) for name, opener in found.items()}
        row = DATASETS[dataset]
        from vggtjax import __version__

        settings: dict[str, Any] = {
            "version": __version__,
            "dataset": dataset,
            "root": str(root.resolve()),
            "gt": gt or row.gt_default,
            "stride": stride,
            "max_frames": max_frames,
            "depth_align": depth_align,
            "max_depth": row.max_depth,
            "empty": empty,
        }
        warnings: list[str] = []
        if folders:
            if fusion is not None:
                raise InputError("--fusion and --results are given; results are made already, give one of them")
            settings |= {"format": layout or "vggtjax", "quaternion": quaternion}
            source: Any = _Folders(folders, layout or "vggtjax", quaternion)
        else:
            loaded = _load(report, model or "demo")
            options = {
                "mask_pairs": mask_pairs,
                "align_scale": align_scale,
                "smooth_frames": smooth_frames,
                "compute_dtype": dtype,
            }
            if fusion is not None:
                from vggtjax.method.fusion_file import read_fusion, warn_if_fitted_otherwise

                options["fusion"] = read_fusion(fusion, names)
                warn_if_fitted_otherwise(fusion, loaded, align_scale=align_scale, mask_pairs=mask_pairs)
            source = _Methods(loaded, names, mode, loaded.config.image_size if size is None else size, options)
            settings |= {"model": _identity(loaded), "mode": mode, "size": source.size, **options}
            if fusion is not None:
                from vggtjax.method.fusion_file import fusion_digest

                settings["fusion"] = fusion_digest(options["fusion"])
            if not loaded.trained:
                warnings.append(_UNTRAINED)
        store.begin()
        scoring = Scoring(depth_align, row.max_depth, empty)
        records = run(found, source, store, settings, scoring, on_stage=report.stage)
        with report.stage("draw"):
            write_report(out, records, store, settings, warnings=warnings)
    report.means(summary(records))
    for record in records:
        if record.status == "failed":
            report.line(f"{record.name}, {record.method}: failed: {record.reason}")
    for note in dict.fromkeys(note for record in records for note in record.notes):
        report.line(f"note: {note}")
    for warning in warnings:
        report.line(warning)
    report.line(f"Look at {out / 'index.html'}")
    if all(record.status == "failed" for record in records):
        raise InputError(f"nothing could be scored; {out / 'index.html'} says why")


def _first(opener: Any, count: int) -> Any:
    return lambda: opener().taken(slice(count))


def _method_names(text: str) -> list[str]:
    from vggtjax.options import find_method

    names = list(dict.fromkeys(name.strip() for name in text.split(",")))
    for name in names:
        find_method(name)
    return names


def _folders(
    results: Sequence[str], model: str | None, methods: str | None, layout: str | None, quaternion: str | None
) -> dict[str, Path]:
    """Return the folders to score by name, or raise now what would be raised once for every sequence."""
    from vggtjax.results.foreign import check_quaternion

    if not results:
        for name, value in (("--format", layout), ("--quaternion", quaternion)):
            if value is not None:
                raise InputError(f"{name} is about the folders of --results; give both or neither")
        return {}
    for name, value in (("--model", model), ("--methods", methods)):
        if value is not None:
            raise InputError(f"{name} and --results are two sources of results; give one of them")
    check_quaternion(layout or "vggtjax", quaternion)
    folders: dict[str, Path] = {}
    for text in results:
        name, equals, folder = text.rpartition("=")
        path = Path(folder)
        if not path.is_dir():
            raise InputError(f"--results has {text}, which names no folder; expected NAME=FOLDER")
        name = name if equals else path.resolve().name
        if name in folders:
            raise InputError(f"--results has two folders named {name}; name them apart: NAME=FOLDER")
        folders[name] = path
    return folders


def _load(report: Report, name: str) -> Model:
    with report.stage("load model") as progress:
        from vggtjax.pretrained.load import load_model

        return load_model(name, progress=progress)


def _identity(model: Model) -> dict[str, Any]:
    """Return what tells models apart: the name, and the sum of the file."""
    import hashlib

    digest = None
    if model.path is not None:
        with model.path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
    return {"name": model.name, "parameters": model.parameter_count, "sha256": digest, "trained": model.trained}


class _Methods:
    """Results of a model by several methods; those that mine and suppress alike are made together."""

    def __init__(
        self, model: Model, names: Sequence[str], mode: Literal["crop", "pad"], size: int, options: dict[str, Any]
    ) -> None:
        from vggtjax.clips.preprocessing import Layout
        from vggtjax.options import check_smooth_frames
        from vggtjax.pipeline.several import groups_of_methods

        Layout(mode, size, model.config.patch_size)
        check_smooth_frames(options["smooth_frames"])
        if options["mask_pairs"] < 0:
            raise InputError(f"--mask-pairs is {options['mask_pairs']}; expected at least 0")
        self.names, self.groups = names, groups_of_methods(names)
        self.size = size
        self._mode: Literal["crop", "pad"] = mode
        self._model, self._options = model, options
        self._last: tuple[Any, Clip] | None = None  # the groups of a sequence share its clip

    def identity(self, name: str, sequence: Frames) -> str:
        del name, sequence  # what it depends on is in the settings
        return ""

    def make(self, names: Sequence[str], sequence: Frames, on_stage: OnStage) -> Mapping[str, Reconstruction]:
        from vggtjax.clips.clip import load_clip
        from vggtjax.pipeline.several import reconstruct_methods

        if self._last is None or self._last[0] is not sequence:
            paths = [str(path) for path in sequence.pictures]
            patch = self._model.config.patch_size
            self._last = (sequence, load_clip(paths, mode=self._mode, size=self.size, patch=patch))
        clip = self._last[1]
        return reconstruct_methods(self._model, clip, names, size=self.size, on_stage=on_stage, **self._options)


@dataclass
class _Folders:
    """Results that lie in folders, one for each sequence."""

    folders: Mapping[str, Path]
    layout: str
    quaternion: Literal["xyzw", "wxyz"] | None

    @property
    def names(self) -> list[str]:
        return list(self.folders)

    @property
    def groups(self) -> list[list[str]]:
        return [[name] for name in self.folders]

    def identity(self, name: str, sequence: Frames) -> str:
        from vggtjax.evaluation.run import folder_fingerprint

        return folder_fingerprint(self.folders[name] / sequence.name)

    def make(self, names: Sequence[str], sequence: Frames, on_stage: OnStage) -> Mapping[str, Reconstruction]:
        from vggtjax.evaluation.datasets.pictures import picture_size
        from vggtjax.evaluation.foreign_frames import placed
        from vggtjax.results.reconstruction import Reconstruction

        del on_stage
        sizes = [picture_size(path) for path in sequence.pictures]
        stems = [path.stem for path in sequence.pictures]
        made = {}
        for name in names:
            folder = self.folders[name] / sequence.name
            result = Reconstruction.load(folder, layout=self.layout, quaternion=self.quaternion)
            made[name] = placed(result, self.layout, sizes, stems)
        return made
