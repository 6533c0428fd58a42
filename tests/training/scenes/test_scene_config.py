from typing import Any

import pytest

from vggtjax.errors import InputError
from vggtjax.training.scenes import SceneConfig


def test_bad_values_are_one_sentence():
    cases: Any = (
        ({"height": 7}, "height is 7; expected a whole number of at least 8 and at most 2048"),
        ({"dynamic": 1.5}, "dynamic is 1.5; expected a number of at least 0 and at most 1"),
        ({"motion": (0.0, 3.0)}, r"motion\[1\] is 3.0; expected a number"),
        ({"pitch": (0.0, 90.0)}, r"pitch\[1\] is 90.0; expected a number of at least -60 and at most 60"),
        ({"motion": [[10**400], 1]}, r"motion\[0\]\[0\] is a number of more than 64 bits"),
        ({"frozen": [[]]}, r"frozen is \[\[\]\]; expected true or false"),
    )
    for changes, says in cases:
        with pytest.raises(InputError, match=says):
            SceneConfig(**changes)


def test_parts_of_the_figure_come_first_in_each_kind():
    config = SceneConfig(boxes=2, ellipsoids=1, cylinders=1)
    assert config.kinds == ("box",) * 3 + ("ellipsoid",) * 2 + ("cylinder",) * 5
    assert config.objects == (0, 1, 2, 0, 3, 0, 0, 0, 0, 4)
