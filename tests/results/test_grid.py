import matplotlib as mpl
import numpy as np
import pytest

from vggtjax.results.colors import _RAMPS, color_ramp, hues
from vggtjax.results.grid import BACKGROUND, GAP, MARGIN, Row, draw_grid, fitted


def test_every_picture_has_a_place_of_its_own():
    shades = np.arange(10, 70, 10).reshape(2, 3)
    rows = [Row(f"row {i}", [np.full((4, 5, 3), shade, np.uint8) for shade in row]) for i, row in enumerate(shades)]
    sheet = draw_grid("A title", ["one", "two", "three"], rows, (250, 200), notes="first\nsecond")
    bottom, right = len(sheet) - MARGIN, sheet.shape[1] - MARGIN
    for i, row in enumerate(shades):
        for j, shade in enumerate(row):
            y, x = bottom - (2 - i) * (200 + GAP) + GAP, right - (3 - j) * (250 + GAP) + GAP
            assert (sheet[y : y + 200, x : x + 250] == shade).all()
            assert (sheet[y - GAP + 1 : y, x : x + 250] == BACKGROUND).all()  # labels of columns end above
    assert (sheet[bottom:] == BACKGROUND).all()


def test_a_narrow_picture_leaves_room_for_the_title_and_none_for_labels_that_are_not_there():
    alone = draw_grid("A title", [""], [Row("", [np.full((2, 2, 3), 255, np.uint8)])], (30, 30))
    assert alone.shape[1] == 700 + MARGIN
    assert (alone[-MARGIN - 30 : -MARGIN, MARGIN : MARGIN + 30] == 255).all()
    assert fitted((100, 200), (480, 300)) == (480, 240)
    assert fitted((200, 100), (480, 300)) == (150, 300)
    assert fitted((1, 1000), (100, 100)) == (100, 1)


@pytest.mark.parametrize("name", _RAMPS)
def test_a_ramp_is_the_colour_map_of_its_name(name):
    usual = 255 * mpl.colormaps[name](np.linspace(0, 1, 256))[:, :3]
    ramp = color_ramp(name)
    np.testing.assert_allclose(ramp, usual, atol=0.044 * 255)
    np.testing.assert_array_equal(ramp[[0, -1]], usual[[0, -1]].round())
    np.testing.assert_array_equal(color_ramp(name, 18)[[0, -1]], ramp[[0, -1]])


def test_hues_stand_around_the_circle_and_end_before_red():
    assert hues(3).tolist() == [[255, 0, 0], [0, 255, 0], [0, 0, 255]]
    assert hues(0).shape == (0, 3)
