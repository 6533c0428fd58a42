"""How far results are apart, by hand; bad input."""

import numpy as np
import pytest

from benchmarks import __main__ as benchmarks
from benchmarks.determinism import apart


def test_how_far_results_are_apart_by_hand():
    poses = np.tile(np.eye(3, 4), (2, 1, 1))
    poses[1, :, 3] = [-3, -4, 0]  # 5 from the first camera
    one = {
        "depth": np.array([[2.0, 4.0]]),
        "depth_confidence": np.array([[1.0, 2.0]]),
        "camera_from_world": poses,
        "dynamic_mask": np.array([[True, False]]),
    }
    assert apart(one, one) == (True, 0, 0, 0, 0, 0, 0)
    turned = poses.copy()
    turn = np.radians(2)
    turned[0, :, :3] = [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
    turned[1, :, 3] = [-3, -4.5, 0]
    other = {
        "depth": np.array([[2.2, 4.0]]),
        "depth_confidence": np.array([[1.0, 3.0]]),
        "camera_from_world": turned,
        "dynamic_mask": np.array([[True, True]]),
    }
    assert apart(one, other) == (False, *map(pytest.approx, (0.1, 0.05, 0.5, 2, 0.1, 0.5)))


@pytest.mark.parametrize(("words", "sentence"), [("--ways twice", "ways has 'twice'"), ("--frames 1", "frames is 1")])
def test_bad_input(capsys, words, sentence):
    assert benchmarks.main(["determinism", *words.split()]) == 2
    assert sentence in capsys.readouterr().err
