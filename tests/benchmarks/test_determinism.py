"""How far results are apart, by hand and in every way of running; what the docs say of it; bad input."""

import re
from pathlib import Path

import numpy as np
import pytest

from benchmarks import __main__ as benchmarks
from benchmarks.determinism import MOST, WAYS, apart, differences


def test_how_far_results_are_apart_by_hand():
    poses = np.tile(np.eye(3, 4), (2, 1, 1))
    poses[1, :, 3] = [-3, -4, 0]  # 5 from the first camera
    one = {
        "depth": np.array([[2.0, 4.0]]),
        "depth_confidence": np.array([[1.0, 2.0]]),
        "camera_from_world": poses,
        "intrinsics": np.array([[[4.0, 0, 1], [0, 2, 1], [0, 0, 1]]]),
        "dynamic_mask": np.array([[True, False]]),
    }
    assert apart(one, one) == (True, 0, 0, 0, 0, 0, 0, 0)
    turned = poses.copy()
    turn = np.radians(2)
    turned[0, :, :3] = [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
    turned[1, :, 3] = [-3, -4.5, 0]
    other = {
        "depth": np.array([[2.2, 4.0]]),
        "depth_confidence": np.array([[1.0, 3.0]]),
        "camera_from_world": turned,
        "intrinsics": np.array([[[4.0, 0, 1], [0, 2.5, 1], [0, 0, 1]]]),
        "dynamic_mask": np.array([[True, True]]),
    }
    assert apart(one, other) == (False, *map(pytest.approx, (0.1, 0.05, 0.5, 2, 0.1, 0.25, 0.5)))


@pytest.mark.parametrize(("words", "sentence"), [("--ways twice", "ways has 'twice'"), ("--frames 1", "frames is 1")])
def test_bad_input(capsys, words, sentence):
    assert benchmarks.main(["determinism", *words.split()]) == 2
    assert sentence in capsys.readouterr().err


def test_no_way_of_running_is_further_apart_than_is_promised():
    rows = differences(17, "demo", tuple(WAYS))
    assert {way: row for way, row in rows.items() if not row.within(MOST[way])} == {}


def test_the_page_says_what_is_allowed():
    page = (Path(__file__).parents[2] / "docs" / "promises.md").read_text(encoding="utf-8")
    allowed = page.partition("and allows, in the same quantities")[2].partition("\n\n\n")[0]
    rows = {
        "the same": "again",
        "every other way": "padded",
        "blocks in bfloat16": "bfloat16",
    }
    for begins, way in rows.items():
        cells = next(line for line in allowed.splitlines() if line.startswith(f"| {begins}")).split("|")[3:-1]
        said = [float(number) for number in re.findall(r"[\d.]+(?:e-\d+)?", " ".join(cells))]
        most = MOST[way]
        assert said == [*([most.depth, most.mean_depth] if most.depth else [0]), *most[3:7], 100 * most.mask], way
    assert set(MOST.values()) == {MOST[way] for way in rows.values()}
