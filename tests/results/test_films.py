import numpy as np
import pytest

from tests.shared.room import make_room
from vggtjax.results.films import due_frames, film_frames

RED = np.array([220, 40, 30])


@pytest.fixture(scope="module")
def room():
    return make_room(frames=4, height=56, width=84)


def film(room, **options):
    return list(film_frames(room, **({"size": (84, 56), "fps": 4, "seconds": 1} | options)))


def red(picture):
    return (np.abs(picture.astype(int) - RED).max(axis=-1) < 30).nonzero()[1]


def test_moving_points_play_and_static_ones_stay():
    still = np.tile(make_room(1, 56, 84).camera_from_world, (4, 1, 1))
    depth, mask = np.full((4, 56, 84), 5, np.float32), np.zeros((4, 56, 84), bool)
    images = np.full((4, 56, 84, 3), 90, np.uint8)
    for frame in range(4):
        place = np.s_[frame, 20:36, 20 * frame : 20 * frame + 12]
        depth[place], mask[place], images[place] = 3, True, RED
    room = make_room(4, 56, 84, depth=depth, dynamic_mask=mask, images=images, camera_from_world=still)
    pictures = film(room, path="camera")
    middles = [red(picture).mean() for picture in pictures]
    assert (np.diff(middles) > 5).all()
    for picture in pictures:
        assert (picture[28, 8:-8].min(axis=-1) > 25).all()  # behind the box is the wall of other frames


def test_frames_that_are_due(room):
    assert due_frames(room, 1.0, 8, loops=False).tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    times = make_room(4, timestamps=np.arange(4) / 8)
    assert due_frames(times, 1.0, 16, loops=True).tolist() == [0, 0, 1, 1, 2, 2, 3, 3] * 2
    assert due_frames(times, 1.0, 4, loops=True).tolist() == [0, 1, 2, 3]  # no time to show all of them twice
    assert due_frames(make_room(4, timestamps=None), 1.2, 12, loops=True).tolist() == [0, 1, 2, 3] * 3
    assert due_frames(make_room(1), 1.0, 3, loops=True).tolist() == [0, 0, 0]
