"""What the reader of a data set is: from its root to its sequences, found but not read. Does not import jax."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from vggtjax.evaluation.datasets.frames import Frames
from vggtjax.evaluation.datasets.sequence import Sequence

Opener = Callable[[Frames, str | None], Sequence]  # reads one sequence: which frames, and which of the ground truths
Reader = Callable[[Path], Mapping[str, Opener]]  # finds the sequences of a root, by name
