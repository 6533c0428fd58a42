import pytest

from vggtjax.errors import InputError
from vggtjax.scenes import SceneConfig


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"height": 7}, "height is 7; expected a whole number of at least 8 and at most 2048"),
        ({"width": 4096}, "width is 4096"),
        ({"width": 64.0}, "width is 64.0"),
        ({"frames": 0}, "frames is 0; expected a whole number of at least 1 and at most 1000"),
        ({"frames": True}, "frames is True"),
        ({"samples": 9}, "samples is 9"),
        ({"exposures": 0}, "exposures is 0"),
        ({"boxes": 0}, "boxes is 0"),
        ({"ellipsoids": 65}, "ellipsoids is 65"),
        ({"cylinders": "2"}, "cylinders is '2'"),
        ({"dynamic": 1.5}, "dynamic is 1.5; expected a number of at least 0 and at most 1"),
        ({"static_camera": -0.1}, "static_camera is -0.1"),
        ({"shutter": float("nan")}, "shutter is nan"),
        ({"noise": "0.1"}, "noise is '0.1'"),
        ({"flicker": 2}, "flicker is 2"),
        ({"motion": (1.0, 0.5)}, "the smaller first"),
        ({"motion": 0.5}, "motion is 0.5; expected a list of 2 values"),
        ({"motion": (0.1, 0.2, 0.3)}, "expected a list of 2 values"),
        ({"dynamic": (0.1, 0.2)}, "dynamic is"),
        ({"motion": (0.0, 3.0)}, r"motion\[1\] is 3.0; expected a number"),
        ({"field_of_view": (5.0, 60.0)}, r"field_of_view\[0\] is 5.0"),
        ({"field_of_view": (60.0, 179.0)}, "field_of_view"),
        ({"pitch": (20.0, 10.0)}, r"pitch is \(20.0, 10.0\); expected two numbers, the smaller first"),
        ({"pitch": (0.0, 90.0)}, r"pitch\[1\] is 90.0; expected a number of at least -60 and at most 60"),
        ({"roll": -1.0}, "roll is -1.0; expected a number of at least 0 and at most 180"),
        ({"motion": [[10**400], 1]}, r"motion\[0\]\[0\] is a number of more than 64 bits"),
        ({"frozen": [[]]}, r"frozen is \[\[\]\]; expected true or false"),
    ],
)
def test_bad_values_are_one_sentence(changes, says):
    with pytest.raises(InputError, match=says):
        SceneConfig(**changes)


def test_lists_become_tuples_so_that_a_config_is_static_under_jit():
    config = SceneConfig(motion=[0.1, 0.2], field_of_view=[50, 60])  # type: ignore[arg-type]
    assert hash(config) == hash(SceneConfig(motion=(0.1, 0.2), field_of_view=(50, 60)))


def test_parts_of_the_figure_come_first_in_each_kind():
    config = SceneConfig(boxes=2, ellipsoids=1, cylinders=1)
    assert config.kinds == ("box",) * 3 + ("ellipsoid",) * 2 + ("cylinder",) * 5
    assert config.objects == (0, 1, 2, 0, 3, 0, 0, 0, 0, 4)
