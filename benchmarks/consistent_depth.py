"""Errors before and after consistent depth, on generated or filmed clips: python -m benchmarks consistent-depth."""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import Progress as Bars

from benchmarks.real_clips import load_windows
from vggtjax.cameras import world_from_camera
from vggtjax.clips.clip import load_clip
from vggtjax.clips.media.arrays import in_bytes
from vggtjax.clips.truth import Truth, at_clip_pixels, batched_truth, intrinsics_at_clip_pixels
from vggtjax.errors import InputError, check_extra
from vggtjax.options import MethodName
from vggtjax.pipeline.pretrained.load import load_model
from vggtjax.pipeline.refinement.consistent import consistent_depth as make_consistent
from vggtjax.pipeline.refinement.joining import differences
from vggtjax.pipeline.refinement.refine import refine_with_points
from vggtjax.research.evaluation.metrics.depth import depth_errors, measured, median_scale
from vggtjax.research.evaluation.metrics.trajectory import rotation_error, trajectory_errors
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.storage.markdown import markdown_table
from vggtjax.storage.writing import staging, writing
from vggtjax.training.scenes import SceneConfig, held_out_scenes
from vggtjax.training.scenes.held_out import Kind

METRICS = {
    "abs_rel": "AbsRel", "static": "AbsRel static", "layers": "layers", "rotation": "rotation (deg)",
    "centres": "centres / depth", "focal": "focal length",
}  # fmt: skip


class Job(NamedTuple):
    """A clip with its truth at the result's pixels, and the pictures of its source, if larger."""

    name: str
    pictures: np.ndarray
    truth: Truth


def consistent_depth(
    *, model: str = "demo", out: Path = Path("consistent-depth-benchmark"), kind: Kind = "dynamic", clips: int = 24,
    frames: int = 12, side: int = 288, seed: int = 0, filmed: Path | None = None, points: bool = False,
    shares: tuple[float, ...] = (1.0,), method: MethodName = "4dvggt-m",
) -> None:  # fmt: skip
    """Compare depth and cameras of a method with the truth, before and after they are made consistent.

    Rows: as predicted; by the network's own pixels; by the source's; and by these and bundle-adjusted points.
    Layers are the median |log| between the depths of frames that see one place, by the result's own cameras.

    Args:
        model: "demo", or weights as for vggtjax reconstruct.
        out: folder for rows.json and report.md.
        kind: of the held-out scenes.
        clips: their number.
        frames: of a clip.
        side: of the rendered pictures, in pixels.
        seed: of the scenes.
        filmed: a folder of filmed clips with truth, in plain folders, in windows of `frames`; their source is not read.
        points: a row with bundle adjustment; needs the extra colmap.
        shares: the predicted depth's log errors are shrunk to these shares first, as a better network has them.
        method: that predicts.
    """
    if clips < 1 or not all(0 < share <= 1 for share in shares):
        raise InputError(f"clips is {clips} and shares are {list(shares)}; expected at least 1, and shares in (0, 1]")
    if points:
        check_extra("a row of bundle-adjusted points", "colmap", "pycolmap")
    with staging(out):  # an unwritable folder fails now
        pass
    from vggtjax.pipeline.run import reconstruct

    logging.disable(logging.WARNING)  # reasons stand in the rows
    network, console, rows = load_model(model), Console(stderr=True), []
    if filmed:
        jobs = _filmed(filmed, network.config, frames)
    else:
        with Bars(console=console) as bars:
            task = bars.add_task("render", total=2 * clips)
            scenes = SceneConfig(height=side, width=side, frames=frames, samples=2)
            rendered = held_out_scenes(
                kind, clips, scenes, seed=seed, progress=lambda done, total: bars.update(task, completed=done)
            )
        jobs = _generated(kind, batched_truth(rendered))
    for job in jobs:
        clip = load_clip(job.pictures, size=network.config.image_size, patch=network.config.patch_size)
        result = reconstruct(network, clip, method=method)
        truth = job.truth if filmed else _at_pixels(clip, job.truth)
        for share in shares:
            for way, made, sentence in _ways(_shrunk(result, truth, share), None if filmed else job.pictures, points):
                row = {"clip": job.name, "share": share, "way": way, "sentence": sentence} | _errors(made, truth)
                rows.append(row)
                shown = ", ".join(f"{name} {row[name]:.3f}" for name in METRICS)
                console.print(f"{job.name} x {share:g}, {way}: {shown}", highlight=False, soft_wrap=True)
    text = "\n".join(_table(rows))
    with writing(out / "rows.json") as temporary:
        temporary.write_text(json.dumps(rows, indent=1) + "\n")
    with writing(out / "report.md") as temporary:
        temporary.write_text(text + "\n")
    Console().print(text, markup=False, highlight=False, soft_wrap=True)


def _generated(kind: Kind, truth: Truth) -> Iterator[Job]:
    for number in range(len(truth.images)):
        of_clip = truth.clip(number)
        yield Job(f"{kind} {number}", in_bytes(of_clip.images), of_clip)


def _filmed(folder: Path, config: Any, frames: int) -> Iterator[Job]:
    windows = load_windows(folder, config, frames)
    for number, name in enumerate(windows.names):
        truth = windows.truth.clip(number)
        yield Job(name, in_bytes(truth.images), truth)


def _at_pixels(clip: Any, truth: Truth) -> Truth:
    depth, moving = (at_clip_pixels(clip, values) for values in (truth.depth, truth.dynamic_mask))
    return Truth(clip.images, depth, moving, truth.camera_from_world, intrinsics_at_clip_pixels(clip, truth.intrinsics))


def _shrunk(result: Reconstruction, truth: Truth, share: float) -> Reconstruction:
    """Return the result with a share of the log errors of its depth, after one scale."""
    if share == 1:
        return result
    known = measured(truth.depth)
    true = np.where(known, truth.depth, 1) / median_scale(result.depth, truth.depth)
    depth = np.where(known, true * (result.depth / true) ** share, result.depth)
    return dataclasses.replace(result, depth=depth.astype(np.float32))


def _ways(
    result: Reconstruction, pictures: np.ndarray | None, points: bool
) -> Iterator[tuple[str, Reconstruction, str]]:
    yield "as predicted", result, ""
    made, report = make_consistent(result)
    yield "own pixels", made, report.sentence
    if pictures is not None:
        made, report = make_consistent(result, iter(pictures))
        yield "the source's pixels", made, report.sentence
        if points:
            refined = refine_with_points(result, iter(pictures))
            made, report = make_consistent(refined.result, iter(pictures), points=refined.points)
            yield "with points", made, report.sentence


def _errors(result: Reconstruction, truth: Truth) -> dict[str, float]:
    known, poses = measured(truth.depth), result.camera_from_world.astype(np.float64)
    scale, true = median_scale(result.depth, truth.depth), truth.camera_from_world.astype(np.float64)
    static = depth_errors(result.depth, truth.depth, known & ~truth.dynamic_mask, scale=scale)
    focal = np.median(result.intrinsics[:, 0, 0]) / np.median(truth.intrinsics[:, 0, 0])
    ate = trajectory_errors(world_from_camera(poses), world_from_camera(true)).ate  # type: ignore[arg-type]
    return {
        "abs_rel": depth_errors(result.depth, truth.depth, known, scale=scale).abs_rel,
        "static": static.abs_rel,
        "layers": float(np.median(differences(result))),
        "rotation": rotation_error(poses, true),
        "centres": ate / float(np.median(truth.depth[known])),
        "focal": float(abs(np.log(focal))),
    }


def _table(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield a table for each share: means, their change with its paired standard error, and how many got better."""
    for share in dict.fromkeys(row["share"] for row in rows):
        of = {}
        for row in (row for row in rows if row["share"] == share):
            of.setdefault(row["way"], []).append(row)
        first = of["as predicted"]
        yield f"{len(first)} clips, log errors of depth x {share:g}"
        yield ""
        lines = []
        for way, found in of.items():
            cells = []
            for name in METRICS:
                before, after = (np.array([row[name] for row in each]) for each in (first, found))
                error = (after - before).std(ddof=1) / len(first) ** 0.5 / before.mean() if len(first) > 1 else 0.0
                change = f" ({(after - before).mean() / before.mean():+.1%} ± {error:.1%})"
                cells.append(f"{after.mean():.4f}" + ("" if found is first else change))
            ratio = np.array([row["abs_rel"] for row in found]) / [row["abs_rel"] for row in first]
            cells += ["", ""] if found is first else [f"{(ratio < 1).sum()} of {len(ratio)}", f"{ratio.max():.2f}"]
            lines.append([way, *cells])
        yield markdown_table(["", *METRICS.values(), "better", "worst"], lines, right=True)
