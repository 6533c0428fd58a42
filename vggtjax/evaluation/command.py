"""What `vggtjax evaluate` does: methods, or results of other programs, on the sequences of a data set."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from vggtjax.errors import InputError
from vggtjax.report import Report

if TYPE_CHECKING:
    from vggtjax.checkpoint import Model
    from vggtjax.evaluation.datasets.sequence import Sequence
    from vggtjax.evaluation.run import OnStage, Reconstructor
    from vggtjax.results.reconstruction import Reconstruction

_UNTRAINED = "The weights of this model are untrained: these numbers show that everything runs, and mean nothing else."


def evaluate(
    dataset: tyro.conf.Positional[str],
    root: tyro.conf.Positional[Path],
    /,
    out: Path,
    *,
    model: str = "demo",
    methods: str = "vggt,vggt4d,pose-decoupling,hard-replacement,4dvggt-d",
    results: Path | None = None,
    layout: Annotated[
        Literal["vggtjax", "vggt4d", "monst3r", "cut3r", "da3"] | None, tyro.conf.arg(name="format")
    ] = None,
    quaternion: Literal["xyzw", "wxyz"] | None = None,
    sequences: str | None = None,
    stride: int | None = None,
    max_frames: int | None = None,
    gt: str | None = None,
    depth_align: Literal["metric", "median", "scale", "scale-shift"] = "scale",
    mode: Literal["crop", "pad"] = "crop",
    size: int | None = None,
    mask_pairs: int = 5,
    align_scale: bool = False,
    smooth_frames: int = 1,
    dtype: Literal["float32", "bfloat16"] = "float32",
) -> None:
    """Score methods on a data set with ground truth: cameras, point clouds, masks, depth, uncertainty.

    Sequences that are finished are kept: the same command goes on where it was interrupted.

    Args:
        dataset: its name: composite, hololens, plain, tum, bonn, dycheck, sintel, kitti, davis or 7scenes.
        root: folder of the data set, or of one sequence of it.
        out: folder for results.json, results.csv, table.md, table.tex and index.html.
        model: "demo", a converted .safetensors, a PyTorch checkpoint, or a hub id.
        methods: names of methods, with commas; those that mine alike share one run of the passes.
        results: score the results in this folder instead, one folder for each sequence; no model is run.
        layout: of those folders, by the program that wrote them; vggtjax by default.
        quaternion: order of quaternions in their pred_traj.txt: wxyz as MonST3R and VGGT4D write it, or xyzw.
        sequences: names, with commas; those of the published protocol, or all, by default.
        stride: take every stride-th frame; the published protocol's own by default.
        max_frames: take so many frames at most.
        gt: ground truth to use, where a data set has several: for dycheck easi3r or lidar.
        depth_align: how video depth is brought to metres.
        mode: how frames are fitted to the model: crop or pad.
        size: side in pixels to run at; the model's own by default.
        mask_pairs: number of pairs in which the keys of dynamic tokens are suppressed.
        align_scale: bring the second pass to the first one's scale before fusing (not in the paper).
        smooth_frames: odd number of frames that the saliency is averaged over (not in the papers).
        dtype: of the blocks' matrix products.
    """
    report = Report()
    with report.running():
        from vggtjax.evaluation.datasets import DATASETS, open_dataset
        from vggtjax.evaluation.page import NAMES, check_extras, write_report
        from vggtjax.evaluation.records import FOLDER, Records, summary
        from vggtjax.evaluation.run import Scoring
        from vggtjax.evaluation.run import evaluate as run
        from vggtjax.files import check_free

        check_extras()
        named = list(dict.fromkeys(name.strip() for name in methods.split(",")))
        _check(named, results, layout, max_frames, smooth_frames)
        earlier = (out / "results.json").is_file() or (out / FOLDER).is_dir()
        check_free(out, (*NAMES, FOLDER), replaced=earlier, what="evaluation")
        with report.stage("open data set"):
            chosen = None if sequences is None else tuple(name.strip() for name in sequences.split(","))
            found = open_dataset(dataset, root, sequences=chosen, stride=stride, gt=gt)
            if max_frames is not None:
                found = [sequence.taken(slice(max_frames)) for sequence in found]
        row = DATASETS[dataset]
        settings: dict[str, Any] = _facts(
            dataset=dataset,
            gt=gt or row.gt_default,
            stride=stride,
            max_frames=max_frames,
            depth_align=depth_align,
            max_depth=row.max_depth,
        )
        warnings: list[str] = []
        if results is None:
            loaded = _load(report, model)
            options = {
                "mask_pairs": mask_pairs,
                "align_scale": align_scale,
                "smooth_frames": smooth_frames,
                "compute_dtype": dtype,
            }
            size = loaded.config.image_size if size is None else size
            settings |= {"model": _identity(loaded), "mode": mode, "size": size, **options}
            reconstruct = _by_methods(loaded, mode, size, options)
            if not loaded.trained:
                warnings.append(_UNTRAINED)
        else:
            named = [layout or "vggtjax"]
            settings |= {"results": str(results), "format": named[0], "quaternion": quaternion}
            reconstruct = _from_folders(results, named[0], quaternion)
        store = Records(out)
        scoring = Scoring(depth_align, row.max_depth)
        records = run(found, named, reconstruct, store, settings, scoring=scoring, on_stage=report.stage)
        with report.stage("draw"):
            write_report(out, records, store, settings, warnings=warnings)
    report.means(summary(records))
    for record in records:
        if record.status == "failed":
            report.line(f"{record.name}, {record.method}: failed: {record.reason}")
    for note in dict.fromkeys(note for sequence in found for note in sequence.notes):
        report.line(f"note: {note}")
    for warning in warnings:
        report.line(warning)
    report.line(f"Look at {out / 'index.html'}")


def _check(
    methods: list[str], results: Path | None, layout: str | None, max_frames: int | None, smooth_frames: int
) -> None:
    """Raise now what would otherwise be raised once for every sequence."""
    from vggtjax.methods import check_smooth_frames, find_method

    for name in methods:
        find_method(name)
    check_smooth_frames(smooth_frames)
    if results is None and layout is not None:
        raise InputError("--format says what is in the folders of --results; give both or neither")
    if results is not None and not results.is_dir():
        raise InputError(f"--results is {results}, which is no folder; expected one with a folder for each sequence")
    if max_frames is not None and max_frames < 1:
        raise InputError(f"--max-frames is {max_frames}; expected at least 1")


def _facts(**facts: Any) -> dict[str, Any]:
    from vggtjax import __version__

    return {"version": __version__, **facts}


def _identity(model: Model) -> dict[str, Any]:
    """Return what tells models apart: the name, and size and sum of the file."""
    import hashlib

    digest = None
    if model.path is not None:
        with model.path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
    return {"name": model.name, "parameters": model.parameter_count, "sha256": digest, "trained": model.trained}


def _load(report: Report, name: str) -> Model:
    with report.stage("load model") as progress:
        from vggtjax.checkpoint import load_model

        return load_model(name, progress=progress)


def _by_methods(model: Model, mode: Literal["crop", "pad"], size: int, options: dict[str, Any]) -> Reconstructor:
    from vggtjax.clips.clip import load_clip
    from vggtjax.pipeline import reconstruct_methods

    def reconstruct(sequence: Sequence, methods, on_stage: OnStage) -> Mapping[str, Reconstruction]:
        paths = [str(path) for path in sequence.pictures]
        clip = load_clip(paths, mode=mode, size=size, patch=model.config.patch_size)
        return reconstruct_methods(model, clip, methods, size=size, on_stage=on_stage, **options)

    return reconstruct


def _from_folders(folder: Path, layout: str, quaternion: Literal["xyzw", "wxyz"] | None) -> Reconstructor:
    from vggtjax.clips.images import read_image
    from vggtjax.evaluation.placement import placed
    from vggtjax.results.reconstruction import Reconstruction

    def reconstruct(sequence: Sequence, methods, on_stage: OnStage) -> Mapping[str, Reconstruction]:
        result = Reconstruction.load(folder / sequence.name, layout=layout, quaternion=quaternion)
        sizes = [read_image(path).size for path in sequence.pictures]
        return dict.fromkeys(methods, placed(result, layout, sizes))

    return reconstruct
