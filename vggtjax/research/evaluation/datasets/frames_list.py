"""Lists of the frames that an evaluation takes of each sequence, as public evaluations publish them.

JSON: an object of frames by sequence, {"chess/seq-03": [0, 200, 400]}, in the order in which they are taken, as Pi3 has
it (`datasets/seq-id-maps` of its evaluation). Text: a sequence a line, as PoseDiffusion and Pi3 list RealEstate10K
(`re10k_test_1800.txt`), with frames behind the name or none. Does not import jax.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vggtjax.clips.captures.files import read_text
from vggtjax.errors import InputError, one_line
from vggtjax.storage.json_values import parse_json

RANDOM_FRAMES = 10


class PinnedError(InputError):
    """A sequence that lacks the frames that are asked of it."""


@dataclass(frozen=True)
class Pinned:
    """Frames of one sequence, by their numbers counted from 0 or by the names of their pictures, in this order.

    Without frames, RANDOM_FRAMES of them, drawn as `numpy.random.RandomState(seed).choice(count, 10, replace=False)`.
    """

    frames: tuple[int | str, ...] = ()
    seed: int = 0
    source: str = "--frames-seed"

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 2**32:
            raise InputError(f"frames_seed is {self.seed}; expected a whole number from 0 to {2**32 - 1}")

    def places(self, names: Sequence[str], sequence: str) -> list[int]:
        """Return the frames' places among `names`; raises PinnedError for a frame that is not there."""
        count = len(names)
        if not self.frames:
            if count < RANDOM_FRAMES:
                raise PinnedError(
                    f"sequence {sequence} has {count} frames; expected {RANDOM_FRAMES} or more to draw from; leave it "
                    "out by --sequences"
                )
            return np.random.RandomState(self.seed).choice(count, RANDOM_FRAMES, replace=False).tolist()
        found = {name: place for place, name in enumerate(names)} | {place: place for place in range(count)}
        if missing := [frame for frame in self.frames if frame not in found]:
            raise PinnedError(
                f"{self.source} names frame {one_line(str(missing[0]), 60)} of sequence {sequence}, which has {count} "
                f"frames, {names[0]} to {names[-1]}; get the sequence whole, or mend the list"
            )
        return [found[frame] for frame in self.frames]


def read_frames_list(path: Path, seed: int = 0) -> dict[str, Pinned]:
    """Return the frames of each sequence of a list; raises InputError for a file of another kind."""
    text = read_text(path)
    listed: Mapping[str, Any] = (
        parse_json(text, dict[str, Any], f"list of frames {path}") if text.lstrip()[:1] == "{" else dict(_lines(text))
    )
    if not listed:
        raise InputError(
            f"{path} lists no sequence; expected a JSON object of frames by sequence, or a sequence a line"
        )
    for name, frames in listed.items():
        good = isinstance(frames, list) and all(type(frame) in (int, str) for frame in frames)
        if not good or len(set(frames)) < len(frames):
            raise InputError(
                f"{path} has {one_line(str(frames), 60)} for sequence {one_line(name, 60)}; expected a list of numbers "
                "or names of frames, each once"
            )
    return {name: Pinned(tuple(frames), seed, str(path)) for name, frames in listed.items()}


def _lines(text: str) -> Iterator[tuple[str, list[int | str]]]:
    for words in map(str.split, text.splitlines()):
        if words and not words[0].startswith("#"):
            yield words[0], [int(word) if re.fullmatch("0|[1-9][0-9]{0,8}", word) else word for word in words[1:]]


def listed_sequences(path: Path, pinned: Mapping[str, Pinned], wanted: Iterable[str] | None) -> list[str]:
    """Return the sequences of a list, or the wanted ones; raises InputError for one that is not in the list."""
    wanted = list(pinned) if wanted is None else [wanted] if isinstance(wanted, str) else list(wanted)
    for name in wanted:
        if name not in pinned:
            raise InputError(
                f"{path} has no frames of sequence {name}; add a line for it, or leave it out of --sequences"
            )
    return wanted
