"""What a part of gpu-day tells, line by line: JSON in a file, so that a part that is cut off keeps what it has told."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

Line = dict[str, Any]
Cell = str | int | float | bool | None


class Lines:
    """Appends lines to a file."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def facts(self, **facts: Cell) -> None:
        """Tell facts by name."""
        self._add({"facts": facts})

    def row(self, sheet: str, **cells: Cell) -> None:
        """Tell a row of the table of this title; `holds` among the cells tells whether a bound or target is met."""
        self._add({"sheet": sheet, "cells": {name.replace("_", " "): value for name, value in cells.items()}})

    def _add(self, line: Line) -> None:
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")


def read_lines(path: Path) -> list[Line]:
    """Return the whole lines of a file; none where there is no file yet."""
    if not path.exists():
        return []
    *whole, _ = path.read_text(encoding="utf-8").split("\n")
    return [json.loads(line) for line in whole]
