"""What `vggtjax evaluate` does: methods, or results of other programs, on the sequences of a data set."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from vggtjax.commands.report import Report
from vggtjax.errors import InputError

if TYPE_CHECKING:
    from vggtjax.evaluation.sources import FolderSource, ModelSource


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
        with report.stage("open data set"):
            from vggtjax import __version__
            from vggtjax.evaluation.datasets import DATASETS, find_sequences
            from vggtjax.evaluation.page import check_report, write_report
            from vggtjax.evaluation.records import Records, summary
            from vggtjax.evaluation.run import Scoring
            from vggtjax.evaluation.run import evaluate as run

            store = Records(out)
            check_report(out, store)
            chosen = None if sequences is None else _words(sequences)
            found = find_sequences(dataset, root, sequences=chosen, stride=stride, max_frames=max_frames, gt=gt)
        if results:
            _refuse({"--model": model, "--methods": methods, "--fusion": fusion}, "and --results exclude each other")
            source = _folder_source(results, layout or "vggtjax", quaternion)
        else:
            _refuse({"--format": layout, "--quaternion": quaternion}, "is about the folders of --results")
            options = {"mask_pairs": mask_pairs, "align_scale": align_scale, "smooth_frames": smooth_frames}
            options |= {"mode": mode, "size": size, "compute_dtype": dtype}
            source = _model_source(report, model or "demo", methods, fusion, options)
        row = DATASETS[dataset]
        settings = {
            "version": __version__,
            "dataset": dataset,
            "root": str(root.resolve()),
            "gt": gt or row.gt_default,
            "stride": stride,
            "max_frames": max_frames,
            "depth_align": depth_align,
            "max_depth": row.max_depth,
            "empty": empty,
            **source.settings,
        }
        store.begin()
        scoring = Scoring(depth_align, row.max_depth, empty)
        records = run(found, source, store, settings, scoring, on_stage=report.stage)
        with report.stage("draw"):
            write_report(out, records, store, settings, warnings=source.warnings)
    report.means(summary(records))
    for record in records:
        if record.status == "failed":
            report.line(f"{record.name}, {record.method}: failed: {record.reason}")
    for note in dict.fromkeys(note for record in records for note in record.notes):
        report.line(f"note: {note}")
    for warning in source.warnings:
        report.line(warning)
    report.line(f"Look at {out / 'index.html'}")
    if all(record.status == "failed" for record in records):
        raise InputError(f"nothing could be scored; {out / 'index.html'} says why")


def _words(text: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(word.strip() for word in text.split(",")))


def _refuse(options: Mapping[str, object], reason: str) -> None:
    for name, value in options.items():
        if value is not None:
            raise InputError(f"{name} {reason}; give both or neither")


def _folder_source(results: Sequence[str], layout: str, quaternion: Literal["xyzw", "wxyz"] | None) -> FolderSource:
    from vggtjax.evaluation.sources import FolderSource

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
    return FolderSource(folders, layout, quaternion)


def _model_source(
    report: Report, model: str, methods: str | None, fusion: Path | None, options: dict[str, Any]
) -> ModelSource:
    from vggtjax.options import METHODS, find_method

    names = tuple(METHODS) if methods is None else _words(methods)
    for name in names:
        find_method(name)
    with report.stage("load model") as progress:
        from vggtjax.evaluation.sources import ModelSource
        from vggtjax.pretrained.load import load_model

        loaded = load_model(model, progress=progress)
    if fusion is not None:
        from vggtjax.method.fusion_file import read_fusion, warn_if_fitted_otherwise

        options["fusion"] = read_fusion(fusion, names)
        about = {name: options[name] for name in ("align_scale", "mask_pairs")}
        warn_if_fitted_otherwise(fusion, loaded, **about)
    return ModelSource(loaded, names, **options)
