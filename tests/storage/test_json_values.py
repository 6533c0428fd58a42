from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import pytest
from msgspec import Meta

from vggtjax.errors import CheckpointError, InputError
from vggtjax.storage.json_values import MOST_LEVELS, Count, Natural, Share, check_fields, parse_json, read_json


@dataclass(frozen=True)
class Phase:
    steps: Count
    frames: Annotated[tuple[Natural, ...], Meta(min_length=1)] = (2,)
    share: Share = 0.0
    kind: Literal["short", "long"] = "short"

    def __post_init__(self) -> None:
        check_fields(self, "phase")
        if self.steps == 13:
            raise InputError("steps is 13; expected any other number")


@dataclass(frozen=True)
class Plan:
    name: str = ""
    phases: tuple[Phase, ...] = ()
    size: tuple[Count, Count] = (1, 2)
    first: Phase | None = None
    notes: dict[str, Any] = field(default_factory=dict)
    scores: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_fields(self)


def test_valid_text_becomes_the_dataclass():
    text = '{"phases": [{"steps": 3, "frames": [1, 2], "share": 1}], "first": null, "notes": {"a": [true]}}'
    plan = parse_json(text, Plan, "plan")
    assert plan == Plan(phases=(Phase(3, (1, 2), 1.0),), notes={"a": [True]})
    assert type(plan.phases[0].share) is float
    assert parse_json(b'{"a": 1}', dict[str, int], "table") == {"a": 1}


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "plan a.json is not JSON that can be read: Input data was truncated"),
        ('{"nmae": "x"}', "plan a.json has unknown fields ['nmae']; expected some of ['name', "),
        ('{"phases": [{"steps": 1}, {"steps": 1, "stesp": 2}]}', "plan a.json: phases[1] has unknown fields ['stesp']"),
        ('{"phases": [{}]}', "plan a.json: phases[0] lacks the field 'steps'"),
        ('{"phases": [{"steps": 0}]}', "phases[0].steps is 0; expected a whole number of at least 1"),
        ('{"phases": [{"steps": 13}]}', "plan a.json: phases[0]: steps is 13; expected any other number"),
        ('{"first": {"steps": 1, "frames": []}}', "first.frames is []; expected a list of at least 1 values"),
        ('{"first": {"steps": 1, "kind": "wide"}}', "first.kind is 'wide'; expected one of ('long', 'short')"),
        ('{"scores": {"a": NaN}}', "has NaN, which is no number; expected finite numbers"),
        ('{"scores": {"a": -Infinity}}', "has -Infinity, which is no number"),
        ('{"note": "mean, nan", "b": tru}', "is not JSON that can be read"),
        ('{"scores": {"a": 1' + "0" * 400 + "}}", "scores.a is a number of more than 64 bits"),
        ('{"notes": {"a b": [1, 1' + "0" * 400 + "]}}", "notes['a b'][1] is a number of more than 64 bits"),
        ('{"notes": {"a": ' + "[" * 100 + "]" * 100 + "}}", f"is nested more than {MOST_LEVELS} levels deep"),
        (b'{"name": "\xff"}', "is not JSON that can be read"),
    ],
)
def test_a_problem_is_one_sentence(text, sentence):
    with pytest.raises(InputError, match=re.escape(sentence)):
        parse_json(text, Plan, "plan a.json")


def test_sizes_are_bounded(tmp_path):
    with pytest.raises(InputError, match="plan has more than 10 bytes"):
        parse_json(" " * 11, Plan, "plan", most_bytes=10)
    path = tmp_path / "a.json"
    path.write_text(" " * 11 + "{}")
    assert read_json(path, Plan, "plan") == Plan()
    with pytest.raises(CheckpointError, match=r"plan .*a\.json has more than 10 bytes"):
        read_json(path, Plan, "plan", most_bytes=10, error=CheckpointError)
    with pytest.raises(CheckpointError, match=r"cannot read .*b\.json: No such file"):
        read_json(tmp_path / "b.json", Plan, "plan", error=CheckpointError)


def test_python_code_meets_the_same_constraints():
    plan = Plan(phases=[{"steps": 3, "frames": [1]}], size=[3, 4])  # pyright: ignore[reportArgumentType]
    assert plan == Plan(phases=(Phase(3, (1,)),), size=(3, 4))
    first = Phase(1)
    assert Plan(first=first).first is first
    for changes, sentence in (
        ({"steps": 10**5000}, "phase.steps is a number of more than 64 bits"),
        ({"frames": ()}, "phase.frames is "),
        ({"share": math.nan}, "phase.share is nan; expected a finite number"),
    ):
        with pytest.raises(InputError, match=sentence):
            Phase(**({"steps": 1} | changes))  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match=r"scores\.a is -inf"):
        Plan(scores={"a": -math.inf})
    with pytest.raises(InputError, match=r"^phases\[0\] has unknown fields \['x'\]"):
        Plan(phases=({"steps": 1, "x": 2},))  # pyright: ignore[reportArgumentType]


def test_more_values_than_can_be_looked_at_are_refused():
    with pytest.raises(InputError, match="list holds more than 100 values"):
        parse_json("[" + "0," * 100 + "0]", list[int], "list", most_bytes=1600)
    assert len(parse_json("[" + "0," * 98 + "0]", list[int], "list", most_bytes=1600)) == 99
