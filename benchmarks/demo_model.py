"""A model's errors on held-out generated scenes and on filmed clips: python -m benchmarks demo-model."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bars

from benchmarks.blind_guesses import Comparison, Guess, Prior, compare, guesses, training_prior
from benchmarks.held_out import held_out_truth
from benchmarks.plots import plot_ladder, plot_sweep
from benchmarks.real_clips import Windows, load_windows
from benchmarks.summaries import (
    Spread,
    Summary,
    changes_table,
    comparison_table,
    ladder_table,
    saliency_auc,
    summarise,
)
from vggtjax.clips.truth import Truth
from vggtjax.errors import InputError, check_extra
from vggtjax.network.checkpoint import Model
from vggtjax.pipeline.pretrained.load import load_model
from vggtjax.progress import Progress
from vggtjax.research.evaluation.ladder import LadderRow, MaskSource, ladder
from vggtjax.storage.writing import staging, writing
from vggtjax.training.scenes import SceneConfig

CLIPS = Path(__file__).parents[2] / "shared" / "clips"
SUPPRESS = ("zero", "drop")
_AT_ONCE = 4  # clips
SWEPT = ("pose-decoupling", "4dvggt-d")  # methods whose sweep is shown; report.json has all
_READING = """\
Changes are against vggt on the same clips, ± their standard error over clips. Behind them stand two numbers of draws:
in how many the method is better than vggt, and in how many neither vggt nor another method with the same mask, pairs
and suppression is better. Centres and points are in the truth's unit: metres in generated scenes. Points: mean
distance of each pixel's point, after the similarity that brings all camera centres closest; for the first camera,
after it is brought to the true one and depth to the truth by one median scale."""


@dataclasses.dataclass(frozen=True)
class Compared:
    """Clips on which the plain pass was compared with blind guesses."""

    clips: list[str]
    rows: list[LadderRow]
    guesses: list[Guess]
    comparisons: list[Comparison]
    known_cameras: list[Summary]  # of a network that reads them: without and with the true ones


@dataclasses.dataclass(frozen=True)
class Laddered:
    """Dynamic clips, on which every method was run."""

    rows: list[list[LadderRow]]  # of each seed
    summaries: list[Summary]  # for the requested number of pairs
    sweep: list[Summary]  # for every number of pairs, on the first seed
    saliency_auc: Spread | None


@dataclasses.dataclass(frozen=True)
class Settings:
    """The settings; see `demo_model`."""

    static: int
    dynamic: int
    seeds: int
    frames: int
    height: int | None  # as wide as high if None
    mask_pairs: int | None  # the number that the model recommends if None
    sweep: tuple[int, ...]
    training_scenes: int
    assets: Path | None

    def __post_init__(self) -> None:
        lowest = {"static": 0, "dynamic": 0, "frames": 3, "mask_pairs": 0}
        for field in dataclasses.fields(self):
            value, least = getattr(self, field.name), lowest.get(field.name, 1)
            if isinstance(value, int) and value < least:
                raise InputError(f"{field.name} is {value}; expected at least {least}")
        if wrong := [pairs for pairs in self.sweep if pairs < 0]:
            raise InputError(f"sweep has {wrong}; expected numbers of pairs of at least 0")


def demo_model(
    *,
    model: str = "demo",
    out: Path = Path("demo-model-benchmark"),
    static: int = 64,
    dynamic: int = 64,
    seeds: int = 5,
    frames: int = 12,
    height: int | None = None,
    mask_pairs: int | None = None,
    sweep: tuple[int, ...] = (1, 3, 5, 8, 12, 24),
    training_scenes: int = 256,
    clips: Path = CLIPS,
    assets: Path | None = None,
) -> None:
    """Compare a model with guesses without images, and the methods with each other.

    Args:
        model: "demo", or weights as for vggtjax reconstruct.
        out: folder for report.json, report.md and figures.
        static: number of held-out static scenes.
        dynamic: number of held-out dynamic scenes of each seed.
        seeds: number of draws of dynamic scenes, for the spread.
        frames: frames of a scene, and of a window of a filmed clip.
        height: of generated scenes in pixels, a multiple of the model's patch size; by default their width, which is
            the model's image size. The scenes are chosen on square frames whatever it is.
        mask_pairs: pairs in which keys are suppressed; the number that the model recommends by default.
        sweep: further numbers of pairs to try on the first draw of dynamic scenes.
        training_scenes: number of training scenes behind the blind guesses.
        assets: folder of textures, photographs and objects: the scenes are worlds of its test split instead of rooms.
        clips: folder with hololens/ and composite/ inside, filmed clips in the layout plain; absent ones are skipped.
    """
    settings = Settings(static, dynamic, seeds, frames, height, mask_pairs, sweep, training_scenes, assets)
    check_extra("plotting", "train", "matplotlib")  # before hours of measuring
    with staging(out):  # an unwritable folder fails now
        pass
    loaded = load_model(model)
    bench = _Bench(loaded, settings)
    with bench.progress:
        results: dict[str, Any] = {
            "model": loaded.summary(),
            "settings": dataclasses.asdict(settings)
            | {"assets": assets and assets.name}
            | {"height": bench.height, "mask_pairs": bench.pairs}
            | {"threshold": loaded.config.motion.cut_by(None, "otsu")},
        }
        results["static"] = bench.static_scenes() if static else None
        hololens, composite = (bench.windows(clips / name) for name in ("hololens", "composite"))
        results["hololens"] = hololens and bench.compared("hololens", hololens)
        results["composite"] = composite and bench.compared("composite", composite)
        results["composite ladder"] = composite and bench.laddered("composite", [composite.truth])
        results["dynamic"] = bench.dynamic_scenes() if dynamic else None
    text = report_text(loaded, results)
    write_report(out, results, text, bench.pairs)
    console = Console()
    console.print(text, markup=False, highlight=False, soft_wrap=True)
    console.print(
        f"\nwrote {out / 'report.md'}, report.json and figures", markup=False, highlight=False, soft_wrap=True
    )


class _Bench:
    """A model, the settings, and a progress bar for each stretch of work."""

    def __init__(self, model: Model, settings: Settings) -> None:
        self.model, self.settings = model, settings
        self.pairs = model.config.motion.masked_pairs(settings.mask_pairs)
        self.width, patch = model.config.image_size, model.config.patch_size
        self.height = settings.height or self.width
        if self.height % patch:
            raise InputError(f"height is {self.height}; expected a multiple of the model's patch size {patch}")
        columns = (TextColumn("{task.description:<28}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        self.console = Console(stderr=True)
        self.progress = Bars(*columns, console=self.console, disable=not self.console.is_terminal)
        self.priors: dict[tuple[int, int], Prior] = {}

    def stage(self, name: str) -> Progress:
        task = self.progress.add_task(name, total=None)

        def advance(done: int, total: int | None) -> None:
            self.progress.update(task, completed=done, total=total)
            if done == total and not self.console.is_terminal:  # a log gets a line for each stretch
                self.console.print(f"{name}: done", highlight=False)

        return advance

    def static_scenes(self) -> Compared:
        truth = self.scenes("static", self.settings.static, 0)
        return self.compared("static scenes", Windows([f"scene {i}" for i in range(len(truth.images))], truth))

    def dynamic_scenes(self) -> Laddered:
        seeds = range(self.settings.seeds)
        return self.laddered("dynamic scenes", (self.scenes("dynamic", self.settings.dynamic, seed) for seed in seeds))

    def windows(self, folder: Path) -> Windows | None:
        return load_windows(folder, self.model.config, self.settings.frames) if folder.is_dir() else None

    def compared(self, name: str, clips: Windows) -> Compared:
        names, truth = clips
        prior = self.prior(truth.images.shape[2], truth.images.shape[3])
        plain = partial(ladder, self.model, truth, methods=["vggt"], batch_size=_AT_ONCE)
        rows, given = plain(progress=self.stage(name)), []
        if self.model.config.reads_cameras:
            told = plain(known_cameras=True, progress=self.stage(f"{name}, known cameras"))
            given = summarise([[*rows, *(dataclasses.replace(row, method="known cameras") for row in told)]])
        guessed = guesses(truth, prior)
        return Compared(names, rows, guessed, compare(rows, guessed), given)

    def laddered(self, name: str, truths: Iterable[Truth]) -> Laddered:
        settings, rows = self.settings, []
        for seed, truth in enumerate(truths):
            pairs = {self.pairs, *(settings.sweep if seed == 0 else ())}
            how: dict[str, Any] = {"mask_pairs": sorted(pairs), "suppress": SUPPRESS, "batch_size": _AT_ONCE}
            how["masks"] = get_args(MaskSource)
            rows.append(ladder(self.model, truth, **how, progress=self.stage(f"ladder, {name} {seed}")))
        main = [[row for row in found if row.mask_pairs in (None, self.pairs)] for found in rows]
        swept = rows[:1] if settings.sweep else []
        return Laddered(rows, summarise(main), summarise(swept), saliency_auc(rows))

    def scenes(self, kind: Literal["static", "dynamic"], count: int, seed: int) -> Truth:
        config = SceneConfig(self.height, self.width, self.settings.frames, dynamic=kind == "dynamic")
        return held_out_truth(kind, count, config, seed=seed, assets=self.settings.assets)

    def prior(self, height: int, width: int) -> Prior:
        if (height, width) not in self.priors:
            config = SceneConfig(height=height, width=width, frames=self.settings.frames)
            advance = self.stage(f"training scenes {width} x {height}")
            self.priors[height, width] = training_prior(config, self.settings.training_scenes, progress=advance)
        return self.priors[height, width]


def report_text(model: Model, results: dict[str, Any]) -> str:
    """Return the report as markdown."""
    frames, size = results["settings"]["frames"], f"{model.config.image_size} x {results['settings']['height']}"
    parts = [
        f"# Benchmark of {model.name}",
        f"{model.parameter_count / 1e6:.1f} M parameters, {frames} frames a clip, generated ones of {size} pixels.",
    ]
    if left_out := [name for name in ("static", "hololens", "composite", "dynamic") if not results[name]]:
        parts.append(f"Left out, as not asked for or not there: {', '.join(left_out)}.")
    for name in ("static", "hololens", "composite"):
        if compared := results[name]:
            parts += [f"## Plain pass against blind guesses: {name}, {len(compared.clips)} clips"]
            parts += [comparison_table(compared.comparisons), *_failures(compared.rows)]
            if given := compared.known_cameras:
                parts += [f"## The network reads true cameras: {name}", ladder_table(given), "Changes:"]
                parts += [changes_table(given)]
    if results["composite ladder"] or results["dynamic"]:
        parts += ["## How to read the tables of methods", _READING]
    for name in ("composite ladder", "dynamic"):
        if laddered := results[name]:
            auc = laddered.saliency_auc
            parts += [f"## Methods: {name}", f"{_draws(len(laddered.rows))} Saliency AUC {auc.text() if auc else '-'}."]
            parts += [ladder_table(laddered.summaries), "Changes:", changes_table(laddered.summaries)]
            parts += _failures(row for rows in laddered.rows for row in rows)
            if swept := sorted(
                (s for s in laddered.sweep if s.method in SWEPT),
                key=lambda s: (s.method, s.mask_source, s.suppress, s.mask_pairs),
            ):
                parts += [f"## Pairs with suppressed keys: {name}", _draws(1)]
                parts += [ladder_table(swept), "Changes:", changes_table(swept)]
    return "\n\n".join(parts)


def write_report(out: Path, results: dict[str, Any], text: str, mask_pairs: int) -> None:
    """Write report.json, report.md and the figures."""
    with writing(out / "report.json") as temporary:
        temporary.write_text(json.dumps(results, default=dataclasses.asdict, indent=1, allow_nan=False) + "\n")
    with writing(out / "report.md") as temporary:
        temporary.write_text(text + "\n")
    for name in ("composite ladder", "dynamic"):
        if not (laddered := results[name]):
            continue
        stem = name.replace(" ", "-")
        for how in SUPPRESS:
            chosen = [s for s in laddered.summaries if s.suppress in (None, how)]
            title = f"{name}, {mask_pairs} pairs, keys {'zeroed' if how == 'zero' else 'dropped'}"
            plot_ladder(out / f"{stem}-{how}.png", chosen, title)
        for method in SWEPT if laddered.sweep else ():
            plot_sweep(out / f"{stem}-sweep-{method}.png", laddered.sweep, method)


def _draws(count: int) -> str:
    return "Means over one draw of clips." if count == 1 else f"Means over {count} draws ± their standard deviation."


def _failures(rows) -> list[str]:
    sentences = dict.fromkeys(row.failure for row in rows if row.failure)
    return ["What could not be computed: " + "; ".join(sentences) + "."] if sentences else []
