"""The made-up room as a sequence with ground truth: what a perfect method would get everything right on."""

from pathlib import Path
from typing import Any

import numpy as np

from tests.room import make_room
from vggtjax.evaluation.datasets.sequence import LabelledSequence
from vggtjax.results.reconstruction import Reconstruction


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
