"""Accuracy of masks: mined, smoothed over time, refined by projection: python -m benchmarks masks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.real_clips import is_clip_folder, load_windows
from vggtjax.checkpoint import Model
from vggtjax.clips.clip import load_clip
from vggtjax.clips.truth import Truth
from vggtjax.errors import InputError
from vggtjax.evaluation.metrics.masks import jaccard
from vggtjax.method.mask import smooth_over_time, upsample
from vggtjax.method.mask_refinement import refine_masks
from vggtjax.options import find_method
from vggtjax.pipeline.run import reconstruct
from vggtjax.pretrained.load import load_model
from vggtjax.scenes import SceneConfig, held_out_scenes

BEST = "at the best threshold"
REFINED = {"as it is": None, "refined": "result", "refined by true geometry": "truth"}


def masks(
    *,
    model: str = "demo",
    methods: tuple[str, ...] = ("4dvggt-d", "vggt4d"),
    scenes: int = 16,
    frames: int = 12,
    smooth: tuple[int, ...] = (1, 3, 5),
    clips: Path | None = None,
    seed: int = 0,
) -> None:
    """Measure masks against the truth, on held-out dynamic scenes and on filmed clips where they are present.

    Methods without clusters have one more row: the mask at each clip's best threshold, which only the truth tells.

    Args:
        model: "demo", or weights as for vggtjax reconstruct.
        methods: methods whose masks are measured.
        scenes: held-out dynamic scenes.
        frames: of a scene, and of a window of a filmed clip.
        smooth: numbers of frames over which the saliency is averaged.
        clips: folder of folders with rgb/, depth/, mask/, K.txt, world_from_camera.txt; none by default.
        seed: another seed draws other scenes.
    """
    if clips is not None and not clips.is_dir():
        raise InputError(f"{clips} is not a folder; expected a folder of folders with rgb/, depth/, mask/ and cameras")
    if scenes < 1:
        raise InputError(f"scenes is {scenes}; expected at least 1")
    loaded, console = load_model(model), Console()
    side = loaded.config.image_size
    with console.status("scenes"):
        wanted = SceneConfig(height=side, width=side, frames=frames)
        generated = held_out_scenes("dynamic", scenes, wanted, seed=seed)
    groups = {f"{scenes} generated scenes": Truth(*(np.asarray(getattr(generated, name)) for name in Truth._fields))}
    filmed = sorted(folder for folder in clips.glob("*") if is_clip_folder(folder)) if clips else []
    if filmed:
        windows = load_windows(filmed, loaded.config, frames)
        groups[f"{len(windows.names)} windows of {', '.join(folder.name for folder in filmed)}"] = windows.truth
    for name, truth in groups.items():
        table = Table(title=name, title_justify="left", box=None, pad_edge=False)
        for heading in ("method", "smooth", "mask", "IoU", "precision", "recall", "pixels", "IoU better in"):
            table.add_column(heading, justify="left" if heading in ("method", "mask") else "right")
        runs = [(method, window) for method in methods for window in smooth]
        for method, window in track(runs, description=name, console=console, transient=True):
            _add_rows(table, loaded, truth, method, window)
        console.print(table)


def precision_recall(predicted: Bool[np.ndarray, "S H W"], truth: Bool[np.ndarray, "S H W"]) -> tuple[float, float]:
    """Return the correct share of the predicted pixels and the predicted share of the true pixels; 1 without pixels."""
    correct, positives, true_pixels = int((predicted & truth).sum()), int(predicted.sum()), int(truth.sum())
    return correct / positives if positives else 1.0, correct / true_pixels if true_pixels else 1.0


def best_mask(saliency: Float[np.ndarray, "S H W"], truth: Bool[np.ndarray, "S H W"]) -> Bool[np.ndarray, "S H W"]:
    """Return the mask saliency >= t with the largest IoU, of all thresholds t that leave a pixel."""
    order = np.argsort(-saliency, axis=None)
    values, met = saliency.ravel()[order], np.cumsum(truth.ravel()[order])
    ends = np.flatnonzero(np.append(values[1:] < values[:-1], True))  # pixels of equal saliency go together
    iou = met[ends] / (ends + 1 + truth.sum() - met[ends])
    return saliency >= values[ends[np.argmax(iou)]]


def _add_rows(table: Table, model: Model, truth: Truth, method: str, window: int) -> None:
    names = (*REFINED, BEST) if find_method(method).clusters == 0 else tuple(REFINED)
    scores: dict[str, list[tuple[float, ...]]] = {name: [] for name in names}
    for clip in (Truth(*arrays) for arrays in zip(*truth, strict=True)):
        fitted = load_clip(clip.images, size=clip.images.shape[2], patch=model.config.patch_size)
        size = clip.images.shape[2]
        made = reconstruct(model, fitted, method=method, size=size, smooth_frames=window, refine_mask=False)
        geometry: dict[str | None, Any] = {
            "result": (made.depth, made.camera_from_world, made.intrinsics),
            "truth": _in_units(clip),
        }
        found = {}
        if BEST in scores:
            assert made.saliency is not None
            smoothed = smooth_over_time(jnp.asarray(made.saliency[None]), window)
            pixels = np.asarray(upsample(smoothed, clip.images.shape[1:3]))[0]
            found[BEST] = best_mask(pixels, clip.dynamic_mask)
        for name, source in REFINED.items():
            mask = made.dynamic_mask
            if source is not None:
                depth, poses, intrinsics = geometry[source]
                known = depth > 0  # filmed depth has holes without truth
                mask = refine_masks(clip.images, depth, mask, poses, intrinsics, valid=known) | (mask & ~known)
            found[name] = mask
        for name, mask in found.items():
            accuracy = jaccard(mask, clip.dynamic_mask), *precision_recall(mask, clip.dynamic_mask)
            scores[name].append((*accuracy, mask.mean()))
    plain = np.array(scores["as it is"])[:, 0]
    for name, values in scores.items():
        iou, precision, recall, share = np.mean(values, axis=0)
        better = int((np.array(values)[:, 0] > plain).sum())
        cells = (f"{iou:.3f}", f"{precision:.3f}", f"{recall:.3f}", f"{share:.1%}")
        table.add_row(method, str(window), name, *cells, "" if name == "as it is" else f"{better} of {len(values)}")


def _in_units(clip: Truth) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return true depth, 0 where unknown, and cameras, scaled to a distance of about 1 as in VGGT."""
    unit = np.median(clip.depth[clip.depth > 0])
    poses = np.concatenate([clip.camera_from_world[..., :3], clip.camera_from_world[..., 3:] / unit], axis=-1)
    return (
        (np.maximum(clip.depth, 0) / unit).astype(np.float32),
        poses.astype(np.float32),
        clip.intrinsics.astype(np.float32),
    )
