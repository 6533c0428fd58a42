"""Data sets with ground truth: a table of the known data sets, and one function to open them. Does not import jax."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from vggtjax.clips.media.sampling import Sampling
from vggtjax.errors import InputError, reading
from vggtjax.research.evaluation.datasets import published
from vggtjax.research.evaluation.datasets.captures import captures
from vggtjax.research.evaluation.datasets.davis import davis
from vggtjax.research.evaluation.datasets.dycheck import TRUTHS, dycheck
from vggtjax.research.evaluation.datasets.folders import listed
from vggtjax.research.evaluation.datasets.frames_list import Pinned, PinnedError, listed_sequences, read_frames_list
from vggtjax.research.evaluation.datasets.kitti import kitti
from vggtjax.research.evaluation.datasets.motion_masks import fbms, segtrack
from vggtjax.research.evaluation.datasets.plain import plain
from vggtjax.research.evaluation.datasets.sequence import (
    EVERY_FRAME,
    FrameChoice,
    LabelledSequence,
    Reader,
    refuse_left_out,
)
from vggtjax.research.evaluation.datasets.seven_scenes import seven_scenes
from vggtjax.research.evaluation.datasets.sintel import sintel
from vggtjax.research.evaluation.datasets.spatialbench import spatialbench
from vggtjax.research.evaluation.datasets.tapvid3d import tapvid3d
from vggtjax.research.evaluation.datasets.tum import bonn, tum

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Dataset:
    """A data set: its reader, and the sequences and frames of the published protocol."""

    reader: Reader
    description: str
    truth: tuple[
        str, ...
    ]  # of "depth", "poses", "intrinsics", "masks", "tracks"; the notes of a sequence say what it lacks
    frames: FrameChoice = EVERY_FRAME
    sequences: tuple[str, ...] | None = None  # of the published protocol
    max_depth: float | None = None  # metres; the depth of farther pixels counts as unknown
    gt: tuple[str, ...] = ()  # names of ground truths, the default first; empty for a single ground truth

    @property
    def has_protocol(self) -> bool:
        """Whether a published protocol chooses frames or sequences."""
        return self.frames != EVERY_FRAME or self.sequences is not None

    @property
    def gt_default(self) -> str | None:
        """The name of the default ground truth; None for a data set with a single one."""
        return self.gt[0] if self.gt else None


_ROOM = ("depth", "poses", "intrinsics")
_TRACKS = ("poses", "intrinsics", "tracks")

DATASETS: Mapping[str, Dataset] = {
    "plain": Dataset(plain, "folders of rgb/, depth/, mask/, cameras; clips of vggtjax scenes", (*_ROOM, "masks")),
    "composite": Dataset(plain, "filmed objects pasted into a filmed room", (*_ROOM, "masks")),
    "capture": Dataset(captures, "captures of Record3D, Polycam, nerfstudio, COLMAP; exports of results", _ROOM),
    "hololens": Dataset(plain, "a static room, filmed in two takes", _ROOM),
    "tum": Dataset(tum, "TUM RGB-D, moving people", _ROOM, FrameChoice(stride=3, most=90), published.TUM),
    "bonn": Dataset(bonn, "Bonn RGB-D Dynamic", _ROOM, FrameChoice(slice(30, 140)), published.BONN, max_depth=70.0),
    "dycheck": Dataset(dycheck, "DyCheck iPhone", _ROOM, FrameChoice(stride=10), published.DYCHECK, gt=TRUTHS),
    "sintel": Dataset(sintel, "MPI Sintel, final pass", _ROOM, sequences=published.SINTEL, max_depth=70.0),
    "kitti": Dataset(kitti, "KITTI drives", ("depth", "intrinsics"), FrameChoice(most=110), published.KITTI),
    "davis": Dataset(davis, "DAVIS 2016, validation", ("masks",), sequences=published.DAVIS_2016),
    "davis-2017": Dataset(davis, "DAVIS 2017, validation", ("masks",), sequences=published.DAVIS_2017),
    "fbms": Dataset(fbms, "FBMS-59, moving objects", ("masks",)),
    "segtrack": Dataset(segtrack, "SegTrack v2", ("masks",)),
    "7scenes": Dataset(seven_scenes, "7-Scenes", _ROOM),
    "tapvid3d": Dataset(tapvid3d, "TAPVid-3D, points followed in 3-D", _TRACKS),
    "worldtrack": Dataset(tapvid3d, "WorldTrack of St4RTrack", _TRACKS, FrameChoice(most=64)),
    "spatialbench": Dataset(spatialbench, "SpatialBench, all scenes", _ROOM),
    "spatialbench-dynamic": Dataset(partial(spatialbench, dynamics="dynamic"), "SpatialBench, dynamic scenes", _ROOM),
}


def find_sequences(
    name: str,
    root: str | Path,
    *,
    sequences: Iterable[str] | None = None,
    sampling: Sampling = Sampling(),
    gt: str | None = None,
    strict: bool = False,
    frames_list: Path | None = None,
    frames_seed: int | None = None,
) -> dict[str, Callable[[], LabelledSequence]]:
    """Find sequences of a data set; a call opens each of them, and raises errors of that sequence alone.

    Args:
        name: one of DATASETS.
        root: the data set's folder; for "plain", "capture", "tum", "bonn", "dycheck" and "7scenes", one sequence's
            folder too.
        sequences: names of the sequences to open, in order. None takes the published sequences in the root, or all
            sequences if it has none of them; the notes of every sequence and the log name missing and skipped ones.
        sampling: frames of each sequence; its stride replaces the data set's own, a window or cap of the data set
            stays. Pictures have no `fps`.
        gt: name of a ground truth, for a data set with several; the first if None.
        strict: refuse a sequence of which a frame lacks a picture, depth, mask or pose, or has a map of another size.
        frames_list: a file with the frames of each sequence, as `datasets/frames_list.py` reads it: these frames and
            sequences are taken, in place of those of `sampling` and of the published protocol.
        frames_seed: draw ten frames of each sequence for which no list names any, by this seed; 0 in a list.

    Raises:
        InputError: an unknown name, sequence or ground truth, a root without sequences, or one that lacks frames of the
            list. The calls raise it for missing or invalid files of their sequence.
    """
    if name not in DATASETS:
        raise InputError(f"data set {name!r} is not known; expected one of {', '.join(DATASETS)}")
    dataset = DATASETS[name]
    if gt is not None and gt not in dataset.gt:
        raise InputError(f"gt is {gt!r}; {name} has {' and '.join(dataset.gt) or 'one ground truth, so leave it out'}")
    if sampling.fps is not None:
        raise InputError(f"fps is {sampling.fps}, but pictures have no presentation times; use stride")
    root = Path(root)
    if not root.is_dir():
        raise InputError(f"{root} is not a folder; expected the folder of the data set {name}")
    gt = gt or dataset.gt_default
    openers = dataset.reader(root, gt) if gt else dataset.reader(root)
    pinned: Mapping[str, Pinned] = {}
    if frames_list is not None:
        pinned = read_frames_list(frames_list, frames_seed or 0)
        sequences = listed_sequences(frames_list, pinned, sequences)
    chosen, notices = _chosen(name, root, list(openers), sequences)
    if frames_list is None and frames_seed is not None:
        pinned = {sequence: Pinned(seed=frames_seed) for sequence in chosen}
    if pinned and dataclasses.asdict(sampling) != dataclasses.asdict(Sampling()):
        raise InputError("a list or a seed of frames excludes start, stride, max_frames and skip; give one of them")
    for notice in notices:
        logger.warning("%s", notice)
    frames = chosen_frames(name, sampling)

    def opened(name: str) -> LabelledSequence:
        with reading(f"sequence {name}"):
            sequence = openers[name](frames._replace(pinned=pinned.get(name)))
            sequence = refuse_left_out(sequence) if strict else sequence
        said = (*sequence.notes, *(each.sentence for each in sequence.left_out))
        return dataclasses.replace(sequence, notes=(*notices, *(f"{sequence.name}: {note}" for note in said)))

    for sequence in pinned and chosen:  # a list that a sequence lacks frames of is refused before anything is computed
        try:
            openers[sequence](frames._replace(pinned=pinned[sequence]))
        except PinnedError:
            raise
        except InputError:  # its opener raises it when its turn comes
            continue
    return {sequence: partial(opened, sequence) for sequence in chosen}


def chosen_frames(name: str, sampling: Sampling) -> FrameChoice:
    """Return the frames that are taken of each sequence of a data set."""
    return DATASETS[name].frames.sampled(sampling)


def _chosen(
    name: str, root: Path, available: list[str], sequences: Iterable[str] | None
) -> tuple[list[str], tuple[str, ...]]:
    """Return the names of the sequences to open, and notices on skipped and missing sequences."""
    if sequences is not None:
        wanted = [sequences] if isinstance(sequences, str) else list(sequences)
        if unknown := [sequence for sequence in wanted if sequence not in available]:
            raise InputError(f"sequence {unknown[0]!r} of {name} is not in {root}; it has {listed(available)}")
        if not wanted or len(set(wanted)) < len(wanted):
            raise InputError(f"sequences are {wanted}; expected at least one name, each once")
        return wanted, ()
    published = DATASETS[name].sequences
    if published is None:
        return available, ()
    present = [sequence for sequence in published if sequence in available]
    if not present:
        return available, (f"none of the {len(published)} published sequences of {name} is present; took all others",)
    notices: tuple[str, ...] = ()
    if absent := [sequence for sequence in published if sequence not in available]:
        notices += (f"{len(absent)} of {len(published)} published sequences of {name} are missing: "
                    f"{', '.join(absent)}",)  # fmt: skip
    if others := [sequence for sequence in available if sequence not in published]:
        notices += (f"skipped, as in the published protocol of {name}: {listed(others)}",)
    return present, notices
