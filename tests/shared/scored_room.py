"""The made-up room as a sequence with ground truth, and evaluations of results of it."""

from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from tests.shared.room import make_room
from vggtjax.errors import ClipError
from vggtjax.research.evaluation.datasets.sequence import LabelledSequence
from vggtjax.research.evaluation.run import Scoring, evaluate
from vggtjax.results.reconstruction import Reconstruction

SETTINGS = {"version": "0", "dataset": "room"}


def room_and_truth(frames: int = 4, **changes: Any) -> tuple[Reconstruction, LabelledSequence]:
    """Return a perfect result, and the sequence that it is of, at twice its size; `changes` replace fields of that."""
    room = make_room(frames)
    intrinsics = room.intrinsics.astype(np.float64)
    intrinsics[:, :2] *= 2
    fields: dict[str, Any] = {
        "name": "room",
        "pictures": tuple(Path(f"{frame}.png") for frame in range(frames)),
        "depth": lambda frame: room.depth[frame].repeat(2, axis=0).repeat(2, axis=1),
        "mask": lambda frame: room.dynamic_mask[frame].repeat(2, axis=0).repeat(2, axis=1),
        "world_from_camera": room.world_from_camera.astype(np.float64),
        "intrinsics": intrinsics,
    }
    return room, LabelledSequence(**(fields | changes))


@contextmanager
def stage(name):
    yield None


class Perfect:
    """Returns the same result by every method, and remembers what it was asked for."""

    def __init__(self, result, *groups, failing=(), sum_of="1"):
        self.result: Reconstruction = result
        self.groups, self.failing, self.calls, self.sum = groups, failing, [], sum_of
        self.names = [name for group in groups for name in group]

    def fingerprint(self, name, sequence):
        return self.sum

    def results(self, names, sequence, on_stage):
        self.calls.append((sequence.name, tuple(names)))
        if sequence.name in self.failing:
            raise ClipError(f"{sequence.name} cannot be read")
        with on_stage("first pass"):
            pass
        return dict.fromkeys(names, self.result)


def opened(sequences):
    return {sequence.name: (lambda sequence=sequence: sequence) for sequence in sequences}


def run(sequences, results, store, settings=SETTINGS):
    return evaluate(opened(sequences), results, store, settings, Scoring(), on_stage=stage)
