import numpy as np

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
