"""The command `vggtjax fit-fusion`. Does not import jax before it is needed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from vggtjax.commands.report import Report
from vggtjax.errors import InputError, check_extra

if TYPE_CHECKING:
    from vggtjax.checkpoint import Model
    from vggtjax.learning.ablation import RuleScore
    from vggtjax.learning.clip_passes import ClipPasses

GENERATED = "generated"


def fit_fusion(
    out: Path,
    *,
    data: tuple[str, ...] = ("generated=16",),
    model: str = "demo",
    family: tuple[str, ...] = ("scale", "calibrated", "correlated", "features", "robust"),
    objective: Literal["gaussian", "laplace", "joint", "photometric", "geometric"] = "gaussian",
    seeds: int = 5,
    steps: int = 300,
    learning_rate: float = 0.05,
    patience: int = 10,
    held_out: float = 0.25,
    pixels: int = 16384,
    max_frames: int | None = None,
    size: int | None = None,
    mask_pairs: int = 5,
    align_scale: bool = False,
    dtype: Literal["float32", "bfloat16"] = "float32",
) -> None:
    """Fit how the two passes are fused, and see whether it beats the paper's rule on clips that were not fitted to.

    The passes over every clip are kept in the user's cache, and the states of fits in the output folder: the same
    command goes on where it was interrupted.

    Args:
        out: folder for fusion.safetensors (give it to --fusion), one such file for every family, fit.json, table.md and
            pictures.
        data: clips with true depth: "generated=N" for N generated scenes, or DATASET=FOLDER as for evaluate.
        model: "demo", a converted .safetensors, a PyTorch checkpoint, or a hub id.
        family: what is free: scale, calibrated, correlated, features, robust, soft, full, gate, or parts such as
            scale+power+floor+correlation+inflation+distrust+saliency+depth+boundary+dynamic+offset+temperature+gate.
        objective: a likelihood of the true depth (joint: of both passes' errors, which measures their correlation), or
            how well frames agree, which needs no truth to fit (but to score).
        seeds: of splits and pixels: every family is fitted so many times.
        steps: of the optimiser, at most.
        learning_rate: the largest of its schedule.
        patience: looks at the clips kept for stopping, one every 10 steps, after which a fit without gain ends.
        held_out: share of the clips that are kept for the scores, and of the rest for stopping.
        pixels: of each clip that a fit looks at; the gate and the objectives without truth look at four whole frames.
        max_frames: take so many frames of each clip at most (a generated one has 12 by default, and at least).
        size: side in pixels to run at; the model's own by default.
        mask_pairs: number of pairs in which the keys of dynamic tokens are suppressed.
        align_scale: bring the second pass to the first one's scale before the fusion.
        dtype: of the blocks' matrix products.
    """
    if seeds < 1:
        raise InputError(f"seeds is {seeds}; expected at least 1")
    if pixels < 1:
        raise InputError(f"pixels is {pixels}; expected at least 1")
    if max_frames is not None and max_frames < 1:
        raise InputError(f"max_frames is {max_frames}; expected at least 1")
    report = Report()
    with report.running():
        from vggtjax.learning.ablation import ablate, split_clips
        from vggtjax.learning.export import begin, check_folder, save_fits
        from vggtjax.learning.fit import FitConfig
        from vggtjax.method.fusion_rule import parse_family
        from vggtjax.pretrained.load import load_model

        check_extra("drawing a fit", "train", "matplotlib")
        check_folder(out)
        split_clips(3, 0, held_out)  # says what is wrong with it before any pass is run
        for name in family:
            FitConfig(parse_family(name), objective)
        sources = [_source(text, max_frames) for text in data]
        config = FitConfig(objective=objective, steps=steps, learning_rate=learning_rate, patience=patience)
        with report.stage("load model") as progress:
            loaded = load_model(model, progress=progress)
        options = {"mask_pairs": mask_pairs, "compute_dtype": dtype}
        clips: dict[str, ClipPasses] = {}
        for text, source in zip(data, sources, strict=True):
            with report.stage(f"passes, {text}") as progress:
                made = _passes(loaded, source, max_frames, size, options, progress)
                clips |= {f"{text}, {name}": clip for name, clip in made.items()}
        clips = {name: _aligned(clip) for name, clip in clips.items()} if align_scale else clips
        patch = loaded.config.patch_size
        with report.stage("fit") as progress:
            settings: dict[str, Any] = {"seeds": range(seeds), "held_out": held_out, "pixels": pixels}
            scores = ablate(
                list(clips.values()), patch, family, config, folder=begin(out), progress=progress, **settings
            )
        with report.stage("write"):
            chosen = save_fits(
                out,
                scores,
                clips,
                patch,
                config,
                about={
                    "model": loaded.name,
                    "model_sha256": loaded.identity.sha256,
                    "data": list(data),
                    "held_out": held_out,
                    "pixels": pixels,
                    **options,
                }
                | {"align_scale": align_scale, "max_frames": max_frames, "size": size},
            )
    _say(report, scores, chosen, out)
    if not loaded.trained:
        report.line("The weights of this model are untrained: these numbers show that everything runs, no more.")


def _say(report: Report, scores: list[RuleScore], chosen: str, out: Path) -> None:
    from vggtjax.learning.ablation import CHOSEN, METRICS, PAPER, gains, table

    rows = table(scores)
    names = ("abs_rel", "nll", "ece", "ause")
    width = max(map(len, rows))
    report.line(f"{'':{width}}  " + "  ".join(f"{METRICS[name]:>15}" for name in names))
    for rule, row in rows.items():
        cells = (f"{row[name][0]:7.4f} ±{row[name][1]:7.4f}" for name in names)
        report.line(f"{rule:{width}}  " + "  ".join(cells))
    apart = gains(scores).get(CHOSEN, gains(scores).get(chosen))
    if apart is not None:
        count = len({score.seed for score in scores})
        text = (f"{METRICS[name]} {apart[name][0]:+.4f} (lower with {apart[name][2]} of {count})" for name in names[:2])
        name = CHOSEN if CHOSEN in rows else chosen
        report.line(f"{name} against {PAPER}, on clips that were not fitted to: {', '.join(text)}")
    report.line(f"For --fusion: {out / 'fusion.safetensors'} ({chosen}, the lowest NLL on the clips for stopping)")
    report.line(f"Look at {out / 'scores.png'}, {out / 'precision.png'}, {out / 'calibration.png'}")


def _source(text: str, max_frames: int | None) -> tuple[str, str]:
    """Return the name and the place of a source of clips, checked as far as can be without reading it."""
    name, equals, place = text.partition("=")
    if not equals or not place:
        raise InputError(f"--data has {text!r}; expected generated=N or DATASET=FOLDER")
    if name == GENERATED:
        from vggtjax.scenes.held_out import MIN_FRAMES

        if not place.isdecimal() or not 1 <= int(place) <= 10_000:
            raise InputError(f"--data has {text!r}; expected a number of scenes from 1 to 10000")
        if max_frames is not None and max_frames < MIN_FRAMES:
            raise InputError(f"max_frames is {max_frames}; generated scenes have at least {MIN_FRAMES} frames")
        return name, place
    from vggtjax.evaluation.datasets import DATASETS

    if name not in DATASETS:
        raise InputError(f"--data has {text!r}; expected generated=N, or one of {', '.join(DATASETS)} and a folder")
    if not Path(place).is_dir():
        raise InputError(f"--data has {text!r}, and {place} is no folder")
    return name, place


def _passes(
    model: Model,
    source: tuple[str, str],
    max_frames: int | None,
    size: int | None,
    options: dict[str, Any],
    progress: Any,
) -> dict[str, ClipPasses]:
    from vggtjax.learning.clip_passes import dataset_passes, generated_passes

    name, place = source
    common: dict[str, Any] = {"size": size, "options": options, "progress": progress}
    if name == GENERATED:
        more = {} if max_frames is None else {"frames": max_frames}
        return dict(generated_passes(model, int(place), **more, **common))
    return dict(dataset_passes(model, name, Path(place), max_frames=max_frames, **common))


def _aligned(clip: ClipPasses) -> ClipPasses:
    import numpy as np

    from vggtjax.method.fusion import scale_between

    scale = scale_between(clip.depth1[None], clip.depth2[None], clip.dynamic_mask[None])  # pyright: ignore
    return clip._replace(depth2=clip.depth2 * np.asarray(scale)[0])
