"""Camera errors before and after bundle adjustment, on generated clips: python -m benchmarks refine-cameras."""

from __future__ import annotations

import dataclasses
import json
import logging
import multiprocessing
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
from rich.console import Console

from vggtjax.cameras import world_from_camera
from vggtjax.clips.clip import load_clip
from vggtjax.clips.truth import at_clip_pixels, batched_truth
from vggtjax.errors import InputError
from vggtjax.pipeline.pretrained.load import load_model
from vggtjax.pipeline.refinement.refine import check_refinement
from vggtjax.pipeline.refinement.refine import refine_cameras as refine
from vggtjax.research.evaluation.metrics.trajectory import rotation_error, trajectory_errors
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.storage.writing import staging, writing
from vggtjax.training.scenes import SceneConfig, held_out_scenes
from vggtjax.training.scenes.held_out import Kind

MASKS = {"static": ("mined",), "dynamic": ("mined", "none", "true")}
_HEADINGS = (
    "clips", "masks", "number", "ATE falls", "ATE rises", "kept", "ATE", "rotation (deg)", "focal length (%)",
    "reprojection (px)", "seconds",
)  # fmt: skip


class Job(NamedTuple):
    """A clip to refine with one kind of masks."""

    kind: Kind
    clip: int
    masks: str
    result: Reconstruction
    pictures: np.ndarray
    camera_from_world: np.ndarray
    intrinsics: np.ndarray  # in pixels of the pictures


@dataclasses.dataclass(frozen=True)
class Row:
    """Errors of a clip before and after, in metres, degrees, percent of the focal length, and pixels."""

    kind: str
    clip: int
    masks: str
    refined: bool
    reason: str
    ate: tuple[float, float]
    rotation: tuple[float, float]
    focal: tuple[float, float]
    reprojection: tuple[float | None, float | None]
    points: int
    seconds: float


def refine_cameras(
    *,
    model: str = "demo",
    out: Path = Path("refine-cameras-benchmark"),
    static: int = 32,
    dynamic: int = 32,
    frames: int = 12,
    side: int = 256,
    workers: int = 2,
) -> None:
    """Refine the cameras of held-out generated clips; compare them with the truth before and after.

    The model sees the clips at its own size, the matcher at theirs. Moving clips are refined from one result with mined
    masks, without masks, and with true masks, to show what the masks are worth.

    Args:
        model: "demo", or weights as for vggtjax reconstruct.
        out: folder for rows.json and report.md.
        static: number of static clips.
        dynamic: number of clips with moving objects.
        frames: of a clip.
        side: of the rendered pictures, in pixels.
        workers: processes.
    """
    for name, value, least in (("static", static, 0), ("dynamic", dynamic, 0), ("frames", frames, 3)):
        if value < least:
            raise InputError(f"{name} is {value}; expected at least {least}")
    check_refinement(True)
    with staging(out):  # an unwritable folder fails now
        pass
    console = Console(stderr=True)
    config = SceneConfig(height=side, width=side, frames=frames, samples=2)
    rows: list[Row] = []
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        jobs = _jobs(model, {"static": static, "dynamic": dynamic}, config)
        for row in pool.map(_refined, jobs):
            rows.append(row)
            change = f"ATE {row.ate[0]:.3f} -> {row.ate[1]:.3f}" + ("" if row.refined else f" ({row.reason})")
            console.print(f"{row.kind} {row.clip} {row.masks}: {change}", highlight=False, soft_wrap=True)
    text = "\n".join(_table(rows))
    with writing(out / "rows.json") as temporary:
        temporary.write_text(json.dumps([dataclasses.asdict(row) for row in rows], indent=1) + "\n")
    with writing(out / "report.md") as temporary:
        temporary.write_text(text + "\n")
    Console().print(text, markup=False, highlight=False, soft_wrap=True)


def _jobs(model: str, counts: dict[Kind, int], config: SceneConfig) -> Iterator[Job]:
    """Yield the clips with their results and masks."""
    from vggtjax.pipeline.run import reconstruct

    network = load_model(model)
    for kind in get_args(Kind):
        if not counts[kind]:
            continue
        truth = batched_truth(held_out_scenes(kind, counts[kind], config))
        for number in range(counts[kind]):
            pictures = np.rint(255 * truth.images[number]).astype(np.uint8)
            clip = load_clip(pictures, size=network.config.image_size, patch=network.config.patch_size)
            result = reconstruct(network, clip)
            masks = {
                "mined": result.dynamic_mask,
                "none": np.zeros_like(result.dynamic_mask),
                "true": at_clip_pixels(clip, truth.dynamic_mask[number]),
            }
            for name in MASKS[kind]:
                masked = dataclasses.replace(result, dynamic_mask=masks[name])
                poses = truth.camera_from_world[number], truth.intrinsics[number]
                yield Job(kind, number, name, masked, pictures, *poses)


def _refined(job: Job) -> Row:
    logging.disable(logging.WARNING)  # the reasons stand in the rows
    began = time.perf_counter()
    refined, report = refine(job.result, iter(job.pictures))
    seconds = time.perf_counter() - began

    def errors(result: Reconstruction) -> tuple[float, float, float]:
        poses = result.camera_from_world.astype(np.float64)
        true = job.camera_from_world.astype(np.float64)
        ate = trajectory_errors(world_from_camera(poses), world_from_camera(true)).ate
        focal = result.intrinsics[:, 0, 0] * result.source_scale[:, 0] / job.intrinsics[:, 0, 0]
        return ate, rotation_error(poses, true), float(100 * np.median(np.abs(focal - 1)))

    before: Any = errors(job.result)
    ate, rotation, focal = zip(before, errors(refined), strict=True)
    reprojection = (report.error_before, report.error_after)
    kept = (report.refined, report.reason)
    return Row(
        job.kind, job.clip, job.masks, *kept, ate, rotation, focal, reprojection, report.points, round(seconds, 2)
    )


def _table(rows: list[Row]) -> Iterator[str]:
    """Yield the lines of a table: shares of clips, and medians before and after."""
    yield "| " + " | ".join(_HEADINGS) + " |"
    yield "|---|---|" + "---:|" * (len(_HEADINGS) - 2)
    for kind, masks in dict.fromkeys((row.kind, row.masks) for row in rows):
        chosen = [row for row in rows if (row.kind, row.masks) == (kind, masks)]

        def share(numbers: list[bool]) -> str:
            return f"{100 * np.mean(numbers):.0f} %"

        def medians(name: str, digits: int, rows: list[Row] = chosen) -> str:
            pairs = [getattr(row, name) for row in rows if None not in getattr(row, name)]
            return " -> ".join(f"{value:.{digits}f}" for value in np.median(pairs, axis=0)) if pairs else "-"

        yield "| " + " | ".join([
            kind, masks, str(len(chosen)),
            share([row.ate[1] < row.ate[0] for row in chosen]), share([row.ate[1] > row.ate[0] for row in chosen]),
            share([not row.refined for row in chosen]),
            medians("ate", 3), medians("rotation", 2), medians("focal", 1), medians("reprojection", 2),
            f"{np.median([row.seconds for row in chosen]):.1f}",
        ]) + " |"  # fmt: skip
