"""The command `vggtjax evaluate`. Does not import jax before it is needed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from vggtjax.clips.captures.files import folder_name
from vggtjax.clips.media.sampling import Sampling
from vggtjax.clips.preprocessing import Framing
from vggtjax.errors import InputError, one_line
from vggtjax.interface.commands.arguments import EvaluationFolder, QuaternionOrder, Size
from vggtjax.interface.commands.flags import InWords
from vggtjax.interface.commands.models import ModelFiles
from vggtjax.interface.commands.report import Report
from vggtjax.options import METHODS, MethodName, Options, find_method
from vggtjax.results.saving import READ_FORMATS, ReadFormat

if TYPE_CHECKING:
    from vggtjax.research.evaluation.datasets.sequence import FrameChoice
    from vggtjax.research.evaluation.records import Record
    from vggtjax.research.evaluation.sources import FolderSource, ModelSource

_SHOWN = 8  # names of sequences in the first lines


@dataclass(frozen=True)
class EvaluatedOptions(Options):
    """The options of all methods; `--methods` names the methods.

    Attributes:
        consistent_depth: fit depth, cameras and focal length to the pixels of the source, and join what several frames
            see, where nothing moves (not in the papers; off by default here, on in the commands reconstruct and batch)
    """

    method: tyro.conf.Suppress[MethodName] = "4dvggt-d"
    refine_cameras: tyro.conf.Suppress[bool] = False


@dataclass(frozen=True)
class EvaluatedFrames(Sampling):
    """Frames of a data set, which has pictures without presentation times.

    Attributes:
        start: first frame to take, counted from 0 from the first frame of the data set's published protocol
        stride: take every n-th frame; by default as in the published protocol
        max_frames: take at most this many frames, and never more than the published protocol; by default as many as the
            protocol
        skip: frames to leave out, such as 0-2,17, counted as for start; none by default
    """

    fps: tyro.conf.Suppress[float | None] = None


@dataclass(frozen=True)
class Candidates(ModelFiles):
    """A model and its methods.

    Attributes:
        methods: methods, with commas: vggt, vggt4d, pose-decoupling, hard-replacement, 4dvggt-d, 4dvggt-m; all by
            default
    """

    model: Annotated[str | None, tyro.conf.arg(metavar="MODEL", help_behavior_hint="(required without --results)")] = (
        None
    )
    methods: Annotated[str | None, tyro.conf.arg(metavar="METHOD,METHOD", help_behavior_hint="")] = None

    def source(self, report: Report, options: Options, framing: Framing) -> ModelSource:
        """Return the results of the model, loaded as a stage of the report."""
        names = tuple(METHODS) if self.methods is None else _words(self.methods)
        for name in names:
            find_method(name)
        network, fitted = self.load(report, options, names)
        from vggtjax.research.evaluation.sources import ModelSource

        return ModelSource(network, names, options, framing, fitted)


@dataclass(frozen=True)
class Folders:
    """Results of other programs, or earlier ones of ours.

    Attributes:
        results: score results in these folders instead, each with a folder per sequence; no model is run. FORMAT is the
            program that wrote a folder, as of --format
        format: the program whose files the folders of --results have that name none; vggtjax by default
        quaternion: order of the quaternions in pred_traj.txt
    """

    results: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=[FORMAT:]FOLDER ...", help_behavior_hint="")] = ()
    format: InWords[ReadFormat | None] = None
    quaternion: QuaternionOrder = None

    def check(self, candidates: Candidates) -> None:
        """Raise InputError for folders beside a model, and for words about folders without any."""
        if self.results:
            for name, value in vars(candidates).items():
                if value is not None:
                    raise InputError(f"--{name} and --results exclude each other; give one of them")
            return
        for name in ("format", "quaternion"):
            if getattr(self, name) is not None:
                raise InputError(f"--{name} is about the folders of --results; give both or neither")

    def source(self, *, strict: bool = False) -> FolderSource:
        """Return the results in the folders."""
        from vggtjax.research.evaluation.sources import FolderSource

        folders: dict[str, Path] = {}
        formats: dict[str, str] = {}
        for text in self.results:
            name, equals, rest = text.rpartition("=")
            form, colon, folder = rest.partition(":")
            known = bool(colon) and form in READ_FORMATS and not Path(rest).is_dir()
            path = Path(folder if known else rest)
            if not (folder if known else rest) or not path.is_dir():
                raise InputError(
                    f"--results has {text}, which names no folder; expected NAME=FOLDER or NAME=FORMAT:FOLDER, where "
                    f"FORMAT is one of {', '.join(READ_FORMATS)}"
                )
            name = name if equals else folder_name(path)
            if name in folders:
                raise InputError(f"--results has two folders named {name}; give them different names: NAME=FOLDER")
            folders[name], formats[name] = path, form if known else self.format or "vggtjax"
        return FolderSource(folders, formats, self.quaternion, strict)


@dataclass(frozen=True)
class ScoreOptions:
    """What is scored, and how.

    Attributes:
        sequences: names, with commas; the sequences of the published protocol, or all, by default
        frames_list: file with the frames of each sequence, numbers or names, in JSON or text as published; only the
            sequences in the file are scored, and their frames replace those of the protocol
        frames_seed: score ten random frames of each sequence, drawn with this seed; with --frames-list only in
            sequences that the file lists without frames, for which the seed is 0 by default
        gt: ground truth to use, where a data set has several: for dycheck easi3r (the default) or lidar
        depth_align: alignment of video depth to the ground truth: scale, ten rounds of reweighted least squares, as in
            MonST3R and CUT3R; least-absolute, the scale with the least absolute error; scale-shift, scale and shift
            with the least absolute error; median, the ratio of the medians; metric, none
        pairs: how relative poses of all pairs and their AUC are computed: vggt, pi3 or da3 (Depth Anything 3), as their
            evaluations do it, with bins of one degree; matching, the exact AUC of papers on matching
        empty: region similarity J (IoU) of a frame in which nothing moves and nothing is found: 1 (davis) or 0 (vggt4d)
        strict: refuse a sequence of which a frame lacks a picture, depth, mask, pose or result, or has a map of another
            size; the other frames are scored by default
    """

    sequences: Annotated[str | None, tyro.conf.arg(metavar="NAME,NAME", help_behavior_hint="")] = None
    frames_list: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    frames_seed: Annotated[int | None, tyro.conf.arg(metavar="SEED", help_behavior_hint="")] = None
    gt: Annotated[str | None, tyro.conf.arg(metavar="{easi3r,lidar}", help_behavior_hint="")] = None
    depth_align: Literal["metric", "median", "scale", "least-absolute", "scale-shift"] = "scale"
    pairs: Literal["vggt", "pi3", "da3", "matching"] = "vggt"
    empty: Literal["davis", "vggt4d"] = "davis"
    strict: Annotated[bool, tyro.conf.arg()] = False

    @property
    def drawn_frames(self) -> str:
        """Which frames a list or a seed chooses, in words; empty without them."""
        if self.frames_list is None and self.frames_seed is None:
            return ""
        drawn = f"ten at random, by the seed {self.frames_seed or 0}"
        return f"frames: {drawn if self.frames_list is None else f'those of {self.frames_list}, or {drawn}'}"


def evaluate(
    dataset: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATASET")],
    root: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="ROOT")],
    /,
    *,
    sampling: Annotated[EvaluatedFrames, tyro.conf.arg(name="input", help="")] = EvaluatedFrames(),
    framing: Size = Framing(),
    candidates: Annotated[Candidates, tyro.conf.arg(name="model", help="")] = Candidates(),
    options: Annotated[EvaluatedOptions, tyro.conf.arg(name="method", help="")] = EvaluatedOptions(),
    folders: Annotated[Folders, tyro.conf.arg(name="other results", help="")] = Folders(),
    scores: Annotated[ScoreOptions, tyro.conf.arg(name="score", help="")] = ScoreOptions(),
    out: EvaluationFolder,
) -> None:
    """Score methods on a data set with ground truth: cameras, point clouds, masks, depth, uncertainty, tracks.

    Finished sequences are kept: run the same command again to resume.

    Args:
        dataset: name of the data set, such as plain, sintel or davis; an unknown name lists all.
        root: folder of the data set, or of one sequence of it.
        out: folder for results.json, results.csv, table.md, table.tex and index.html.
        candidates: the model and its methods
        folders: results of other programs
        scores: what is scored, and how
        sampling: which frames of a sequence
        framing: how frames are fitted to the model
        options: settings of all methods
    """
    report = Report()
    with report.running():
        report.note(f"score {_subjects(candidates, folders)} on {one_line(dataset)} in {one_line(str(root))}")
        with report.stage("open data set"):
            from vggtjax import __version__
            from vggtjax.research.evaluation.datasets import DATASETS, chosen_frames, find_sequences
            from vggtjax.research.evaluation.page import check_report, write_report
            from vggtjax.research.evaluation.records import Records
            from vggtjax.research.evaluation.run import Scoring
            from vggtjax.research.evaluation.run import evaluate as run

            chosen = None if scores.sequences is None else _words(scores.sequences)
            found = find_sequences(
                dataset,
                root,
                sequences=chosen,
                sampling=sampling,
                gt=scores.gt,
                strict=scores.strict,
                frames_list=scores.frames_list,
                frames_seed=scores.frames_seed,
            )
            store = Records(out)
            check_report(out, store)
        named = ", ".join(one_line(name, 60) for name in list(found)[:_SHOWN])
        more = f" and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
        report.note(f"{len(found)} sequence{'' if len(found) == 1 else 's'}: {named}{more}")
        frames, labels = chosen_frames(dataset, sampling), DATASETS[dataset]
        taken = scores.drawn_frames or _frames_in_words(frames, dataset if labels.has_protocol else None, sampling)
        report.note(taken)
        folders.check(candidates)
        if folders.results:
            source = folders.source(strict=scores.strict)
        else:
            source = candidates.source(report, options, framing)
        settings = {
            "version": __version__,
            "dataset": dataset,
            "root": str(root.resolve()),
            "gt": scores.gt or labels.gt_default,
            "start": frames.window.start or 0,
            "stop": frames.window.stop,
            "stride": frames.stride,
            "max_frames": frames.most,
            "skip": sampling.skip,
            "frames": taken,
            "depth_align": scores.depth_align,
            "max_depth": labels.max_depth,
            "empty": scores.empty,
            "pairs": scores.pairs,
            "strict": scores.strict,
            **({} if folders.results else {"consistent_depth": options.consistent_depth}),
            **source.settings,
        }
        store.begin()
        scoring = Scoring(scores.depth_align, labels.max_depth, scores.empty, scores.pairs, scores.strict)
        records = run(found, source, store, settings, scoring, on_stage=report.stage)
        with report.stage("draw"):
            write_report(out, records, store, settings, warnings=source.warnings)
    _print(report, out, records, source.warnings, settings)


def _frames_in_words(frames: FrameChoice, protocol: str | None, sampling: Sampling) -> str:
    """Return which frames of a sequence are taken, and who chose them: the protocol of a data set, if it has one."""
    every = "every frame" if frames.stride == 1 else f"one frame of {frames.stride} (stride {frames.stride})"
    start, stop = frames.window.start or 0, frames.window.stop
    window = f", from frame {start}" * bool(start or stop) + ("" if stop is None else f" to {stop - 1}")
    most = "" if frames.most is None else f", at most {frames.most}"
    skip = "" if sampling.skip is None else f", without {sampling.skip}" + f" of these from {start}" * bool(stop)
    own = [name for name in ("start", "stride", "max_frames", "skip") if getattr(sampling, name)]
    by = ", ".join(f"--{name.replace('_', '-')}" for name in own)
    default = "" if protocol is None else f", as the protocol of {protocol} has it"
    choice = f", by {by}" if own else f"{default}; --stride, --start, --max-frames and --skip change it"
    return f"frames: {every}{window}{skip}{most}{choice}"


def _subjects(candidates: Candidates, folders: Folders) -> str:
    """Return words for what is scored."""
    if folders.results:
        return one_line(", ".join(folders.results))
    methods = candidates.methods or ", ".join(METHODS)
    return one_line(f"{methods} with {'no model' if candidates.model is None else f'the model {candidates.model}'}")


def _print(
    report: Report, out: Path, records: Sequence[Record], warnings: Sequence[str], settings: Mapping[str, Any]
) -> None:
    """Print the means, each failure, notes and warnings; raises InputError where nothing could be scored."""
    from vggtjax.research.evaluation.page import NO_PLOTS, can_plot
    from vggtjax.research.evaluation.records import summary

    report.means(summary(records))
    failed: dict[str, dict[str, list[str]]] = {}  # by reason: methods by sequence
    for record in records:
        if record.status == "failed":
            failed.setdefault(record.reason, {}).setdefault(record.name, []).append(record.method)
    for reason, found in failed.items():
        names, methods = list(found), dict.fromkeys(method for some in found.values() for method in some)
        more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
        report.line(f"{', '.join(names[:_SHOWN])}{more}, {', '.join(methods)}: failed: {reason}")
    for note in dict.fromkeys(note for record in records for note in record.notes):
        report.line(f"note: {note}")
    for warning in warnings:
        report.line(warning)
    report.line(str(settings["frames"]))
    if (fitted := settings.get("consistent_depth")) is not None:
        how = "fitted to the pixels, by" if fitted else "as predicted; reconstruct fits them to the pixels, and so does"
        report.line(f"depth and cameras: {how} --consistent-depth")
    if not can_plot():
        report.line(NO_PLOTS)
    report.line(f"Look at {out / 'index.html'}")
    if all(record.status == "failed" for record in records):
        raise InputError(f"nothing could be scored; {out / 'index.html'} says why")


def _words(text: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(word.strip() for word in text.split(",")))
