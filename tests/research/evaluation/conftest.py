import dataclasses

import numpy as np
import pytest

from tests.shared.scored_room import room_and_truth


@pytest.fixture
def three(tmp_path):
    """A result, and three sequences that it is nearly right for."""
    pictures = [tmp_path / "pictures" / f"{i}.png" for i in range(4)]
    pictures[0].parent.mkdir()
    for picture in pictures:
        picture.write_bytes(b"a picture")
    room, _ = room_and_truth()
    errors = np.random.default_rng(0).uniform(0.9, 1.1, room.depth.shape).astype(np.float32)
    room = dataclasses.replace(room, depth=room.depth * errors)
    return room, [room_and_truth(name=name, pictures=tuple(pictures))[1] for name in ("a", "b", "../c <i>")]
