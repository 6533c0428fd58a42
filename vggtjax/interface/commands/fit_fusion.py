"""The command `vggtjax fit-fusion`. Does not import jax before it is needed."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from msgspec import Meta

from vggtjax.errors import InputError, check_extra
from vggtjax.interface.commands.flags import InWords
from vggtjax.interface.commands.models import load
from vggtjax.interface.commands.report import Report
from vggtjax.options import MethodName, Options
from vggtjax.storage.json_values import Count, check_fields

if TYPE_CHECKING:
    from vggtjax.network.checkpoint import Model
    from vggtjax.research.learning.ablation import RuleScore
    from vggtjax.research.learning.clip_passes import ClipPasses

GENERATED = "generated"


@dataclass(frozen=True)
class Clips:
    """Clips with true depth. Raises InputError for an invalid value.

    Attributes:
        data: clips with true depth: "generated=N" for N generated scenes, or DATASET=FOLDER as for evaluate
        max_frames: largest number of frames to take of each clip; generated clips have 12 by default, and no fewer
        size: side in pixels to run at; the model's own by default
    """

    data: Annotated[tuple[str, ...], tyro.conf.arg(metavar="DATASET=FOLDER ...")] = ("generated=16",)
    max_frames: InWords[Count | None] = None
    size: InWords[int | None] = None

    def __post_init__(self) -> None:
        check_fields(self)

    def check(self) -> None:
        """Raise InputError for an unknown data set, invalid numbers of clips or frames, or a missing folder."""
        from vggtjax.research.evaluation.datasets import DATASETS, find_sequences
        from vggtjax.research.learning.ablation import split_clips
        from vggtjax.training.scenes.held_out import MIN_FRAMES

        count = 0
        for text in self.data:
            name, _, place = text.partition("=")
            if not place:
                raise InputError(f"--data has {text!r}; expected generated=N or DATASET=FOLDER")
            if name == GENERATED:
                if not place.isdecimal() or not 1 <= int(place) <= 10_000:
                    raise InputError(f"--data has {text!r}; expected a number of scenes from 1 to 10000")
                if self.max_frames is not None and self.max_frames < MIN_FRAMES:
                    raise InputError(
                        f"max_frames is {self.max_frames}; generated scenes have at least {MIN_FRAMES} frames"
                    )
                count += int(place)
            elif name not in DATASETS:
                names = ", ".join(DATASETS)
                raise InputError(f"--data has {text!r}; expected generated=N, or one of {names} and a folder")
            elif not Path(place).is_dir():
                raise InputError(f"--data has {text!r}, and {place} is not a folder")
            else:
                count += len(find_sequences(name, place))
        split_clips(count, 0)

    def passes(self, report: Report, model: Model, options: Options) -> dict[str, ClipPasses]:
        """Return the passes over clips by name, aligned with `align_scale`; each source is a stage of the report."""
        from vggtjax.research.learning.clip_passes import dataset_passes, generated_passes

        clips: dict[str, ClipPasses] = {}
        for text in self.data:
            name, _, place = text.partition("=")
            with report.stage(f"passes, {text}") as progress:
                common: dict[str, Any] = {"size": self.size, "options": options, "progress": progress}
                if name == GENERATED:
                    more = {} if self.max_frames is None else {"frames": self.max_frames}
                    named = generated_passes(model, int(place), **more, **common)
                else:
                    named = dataset_passes(model, name, Path(place), max_frames=self.max_frames, **common)
                clips |= {f"{text}, {clip}": passes for clip, passes in named}
        return {name: aligned(clip) for name, clip in clips.items()} if options.align_scale else clips


@dataclass(frozen=True)
class PassOptions(Options):
    """The options that passes and their fusion depend on."""

    method: tyro.conf.Suppress[MethodName] = "4dvggt-d"
    refine_mask: tyro.conf.Suppress[bool | None] = None
    refine_cameras: tyro.conf.Suppress[bool] = False
    consistent_depth: tyro.conf.Suppress[bool] = False


@dataclass(frozen=True)
class Fits:
    """How fits run. Raises InputError for an invalid value.

    Attributes:
        objective: likelihood of the true depth (joint: of both passes' errors, which measures their correlation), or
            agreement of frames, whose fit needs no truth (only the scores do)
        seeds: number of fits of every family; each seed splits the clips and draws pixels anew
        steps: largest number of steps of the optimiser
        learning_rate: largest rate of the schedule
        patience: evaluations of the clips for early stopping, one every 10 steps, after which a fit without gain ends
        held_out: share of the clips for the scores, and of the other clips for early stopping
        pixels: number of pixels to draw of each clip; the gate and the objectives without truth take four whole frames
    """

    objective: Literal["gaussian", "laplace", "joint", "photometric", "geometric"] = "gaussian"
    seeds: Count = 5
    steps: Count = 300
    learning_rate: float = 0.05
    patience: Count = 10
    held_out: Annotated[float, Meta(gt=0, lt=1)] = 0.25
    pixels: Count = 16384

    def __post_init__(self) -> None:
        check_fields(self)


def fit_fusion(
    out: Path,
    *,
    clips: Clips = Clips(),
    model: Annotated[str | None, tyro.conf.arg(metavar="MODEL", help_behavior_hint="")] = None,
    family: Annotated[tuple[str, ...], tyro.conf.arg(metavar="FAMILY ...")] = (
        "scale",
        "calibrated",
        "correlated",
        "features",
        "robust",
    ),
    fits: Fits = Fits(),
    options: Annotated[PassOptions, tyro.conf.arg(name="method")] = PassOptions(),
) -> None:
    """Fit rules that fuse the two passes, and compare them with the paper's rule on clips that were not fitted to.

    The passes over every clip are kept in the user's cache, and the states of fits in the output folder: the same
    command resumes an interrupted run.

    Args:
        out: folder for fusion.safetensors (give it to --fusion), one such file for every family, fit.json, table.md and
            pictures.
        clips: clips
        model: a converted .safetensors, a PyTorch checkpoint, a hub id, or "demo"; required with DATASET=FOLDER, else
            "demo" by default.
        family: families of rules: scale, calibrated, correlated, features, robust, soft, full, gate, or free parts
            joined by +, such as scale+power, of scale, power, floor, correlation, inflation, distrust, saliency, depth,
            boundary, dynamic, offset, temperature, gate.
        fits: fits
        options: how the passes run
    """
    report = Report()
    with report.running():
        from vggtjax.method.fusion.family import parse_family
        from vggtjax.method.fusion.file import origin_of_fit
        from vggtjax.research.learning.ablation import ablate
        from vggtjax.research.learning.export import begin, check_folder, save_fits
        from vggtjax.research.learning.fit import FitConfig

        check_extra("drawing a fit", "train", "matplotlib")
        check_folder(out)
        clips.check()
        settings = asdict(fits)
        seeds, held_out, pixels = (settings.pop(name) for name in ("seeds", "held_out", "pixels"))
        for name in family:
            FitConfig(parse_family(name), **settings)
        config = FitConfig(**settings)
        is_generated = all(text.startswith(f"{GENERATED}=") for text in clips.data)
        network = load(report, "demo" if model is None and is_generated else model)
        passes = clips.passes(report, network, options)
        sampling: dict[str, Any] = {"held_out": held_out, "pixels": pixels}
        with report.stage("fit") as progress:
            states, every = begin(out), list(passes.values())
            scores = ablate(every, family, config, seeds=range(seeds), folder=states, progress=progress, **sampling)
        with report.stage("write"):
            about = origin_of_fit(network, options) | sampling
            about |= {"data": list(clips.data), "max_frames": clips.max_frames, "size": clips.size}
            chosen = save_fits(out, scores, passes, config, about=about)
    _say(report, scores, chosen, out)
    if network.note:
        report.line(network.warning)


def aligned(clip: ClipPasses) -> ClipPasses:
    """Return a clip with depth and cameras of the second pass in the unit of the first pass."""
    import numpy as np

    from vggtjax.method.fusion.rule import scale_between

    scale = np.asarray(scale_between(clip.depth1[None], clip.depth2[None], clip.dynamic_mask[None]))[0]  # pyright: ignore
    cameras = clip.camera_from_world.copy()
    cameras[..., 3] *= scale
    return clip._replace(depth2=clip.depth2 * scale, camera_from_world=cameras)


def _say(report: Report, scores: list[RuleScore], chosen: str, out: Path) -> None:
    from vggtjax.research.learning.ablation import CHOSEN, METRICS, PAPER, gains, table

    rows = table(scores)
    names = ("abs_rel", "nll", "ece", "ause")
    width = max(map(len, rows))
    report.line(f"{'':{width}}  " + "  ".join(f"{METRICS[name]:>15}" for name in names))
    for rule, row in rows.items():
        cells = (f"{row[name][0]:7.4f} ±{row[name][1]:7.4f}" for name in names)
        report.line(f"{rule:{width}}  " + "  ".join(cells))
    name = CHOSEN if CHOSEN in rows else chosen
    apart = gains(scores).get(name)
    if apart is not None:
        count = len({score.seed for score in scores})
        text = (f"{METRICS[key]} {apart[key][0]:+.4f} (lower with {apart[key][2]} of {count})" for key in names[:2])
        report.line(f"{name} against {PAPER}, on clips that were not fitted to: {', '.join(text)}")
    report.line(f"For --fusion: {out / 'fusion.safetensors'} ({chosen}, the lowest NLL on the clips for stopping)")
    report.line(f"Look at {out / 'scores.png'}, {out / 'precision.png'}, {out / 'calibration.png'}")
