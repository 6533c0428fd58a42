"""Rows of the ladder with a few fields."""

from typing import Any

from vggtjax.evaluation.ladder import LadderRow


def row(**fields) -> LadderRow:
    values: dict[str, Any] = dict.fromkeys(LadderRow.__dataclass_fields__)
    return LadderRow(**(values | {"clip": 0, "method": "vggt", "failure": ""} | fields))
