import numpy as np
import pytest

from tests.room import make_room
from vggtjax.results import previews


def test_overlay_by_hand():
    image = np.full((9, 9, 3), (30, 60, 90), np.uint8)
    mask = np.zeros((9, 9), bool)
    mask[2:7, 2:7] = True
    drawn = previews.overlay(image, mask)
    assert tuple(drawn[4, 4]) == (131, 51, 90)  # 0.55 x image + 0.45 x (255, 40, 90)
    assert tuple(drawn[0, 0]) == (45, 60, 75)  # half way to the mean of its channels
    assert tuple(drawn[2, 4]) == tuple(drawn[1, 4]) == (255, 235, 60)
    assert (image == (30, 60, 90)).all()


@pytest.mark.parametrize("frames", [1, 20])
def test_sheet_shows_frames_in_columns(frames):
    room = make_room(frames)
    sheet = previews.contact_sheet(room)
    assert sheet.dtype == np.uint8
    assert sheet.shape[1] <= 2100
    pure = (sheet == (255, 235, 60)).all(axis=-1).any(axis=0)  # columns of the outline of the moving box
    starts = np.flatnonzero(np.diff(pure.astype(int)) == 1)
    assert min(frames, 8) <= len(starts) <= 2 * min(frames, 8)
