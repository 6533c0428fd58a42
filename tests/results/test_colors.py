"""Colour maps beside those of matplotlib, and hues by hand."""

import matplotlib as mpl
import numpy as np
import pytest

from vggtjax.results.colors import _RAMPS, color_ramp, hues


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
