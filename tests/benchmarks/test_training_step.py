"""The benchmark of the training step: two checkouts of the same package, and bad input."""

import dataclasses
import json
from pathlib import Path

import pytest

from benchmarks import __main__ as benchmarks
from benchmarks.training_step import training_step
from tests.training_runs import RECIPE
from vggtjax.errors import InputError
from vggtjax.training.objective import LossWeights
from vggtjax.training.recipe import Phase

ROOT = Path(__file__).parents[2]
LOSSES = LossWeights(depth=0, points=0, match=1, match_layers=(1,), probe=1)  # two are means over the whole batch


def test_two_checkouts_take_turns(tmp_path):
    """The same package twice, and two workers: equal losses on the same clips; every part took time; right counts."""
    recipe = dataclasses.replace(RECIPE, stages=(Phase(9, 2, (2,), 28, 28),), losses=LOSSES)
    (tmp_path / "recipe.json").write_text(recipe.to_json())
    out = tmp_path / "report.json"
    arguments = ("--recipe", tmp_path / "recipe.json", "--before", ROOT, "--out", out)
    counts = ("--devices", 1, "--steps", 1, "--rounds", 1)
    assert benchmarks.main(["training-step", *map(str, (*arguments, *counts))]) == 0
    report = json.loads(out.read_text())
    alone, before, shared = (side["losses"] for side in report["sides"])
    assert alone == before
    assert alone.keys() == shared.keys()
    assert report["losses_apart"] < 1e-6  # the workers'
    assert report["ratio_to_1"] > 0
    sides = [(side["package"], side["devices"], side["workers"]) for side in report["sides"]]
    assert sides == [("now", 1, 1), ("before", 1, 1), ("now", 1, 2)]
    assert all(seconds > 0 for side in report["sides"] for run in side["runs"] for seconds in run.values())
    C, depth = recipe.model.embed_dim, recipe.model.depth + recipe.model.dino_depth / 2
    least = 3 * 2 * 2 * depth * 2 * 24 * C**2 * (28 // recipe.model.patch_size) ** 2  # the blocks' linear layers alone
    assert least < report["flop"] < 100 * least


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"rounds": 0}, r"rounds are \(1, 2\), 2, 2 and 0"),
        ({"devices": ()}, r"rounds are \(\), 2, 2 and 5"),
        ({"workers": 0}, "0, 2 and 5; expected at least 1"),
        ({"workers": 3}, "workers is 3; expected a divisor of the batch of every phase; one is 8 clips"),
        ({"before": Path("/")}, "no vggtjax"),
    ],
)
def test_bad_input(option, message):
    with pytest.raises(InputError, match=message):
        training_step(**option)
