"""Results as one page of HTML that plays them: it holds everything, opens from a file, and asks no server."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from vggtjax.errors import InputError, one_line
from vggtjax.progress import Progress
from vggtjax.results.result import Result
from vggtjax.results.viewer.home import SAME_PLACE
from vggtjax.results.viewer.scene import Budget, place_beside, scene_of
from vggtjax.storage.writing import writing

_FARTHEST = 1e30
MOST_RESULTS = 9  # the keys 1 to 9 choose one
# In the order in which they build on each other; joined to one script.
_SCRIPTS = ("maths", "data", "shaders", "painter", "targets", "camera", "viewer", "welcome", "controls", "main")


def viewer_page(
    results: Sequence[Result],
    *,
    names: Sequence[str] | None = None,
    budget: Budget = Budget(),
    progress: Progress | None = None,
) -> str:
    """Return a page that plays results: moving points over a static background, cameras, pictures, tracks.

    The first view is that of the first result; the others are placed on its first camera, at its scale. All text of the
    results is escaped, and the page's own policy forbids it to load anything.

    Args:
        results: at least one, at most nine; they may differ in frames and sizes.
        names: one for each; by default their methods and models.
        budget: the most points of each result.
        progress: called with the number of frames done, and of all.

    Raises InputError for another number of results or names.
    """
    check_count(len(results))
    for result in results:
        if not isinstance(result, Result):
            raise InputError(f"a {type(result).__name__} is given to the viewer; expected results, one by one")
    names = [f"{result.method}, {result.model_name}" for result in results] if names is None else list(names)
    if len(names) != len(results):
        raise InputError(f"{len(names)} names for {len(results)} results; expected one for each")
    scenes, total = [], sum(len(result.depth) for result in results)
    for number, (result, name) in enumerate(zip(results, names, strict=True)):
        before = sum(len(earlier.depth) for earlier in results[:number])
        step = None if progress is None else lambda done, _, before=before: progress(before + done, total)
        with np.errstate(over="ignore", invalid="ignore"):  # worlds of untrained weights
            place = SAME_PLACE if number == 0 else place_beside(result, results[0])
            scenes.append(scene_of(result, name, place, budget=budget, progress=step))
    return _page(one_line(" | ".join(names), 120), scenes)


def check_count(results: int) -> None:
    """Raise InputError for a number of results that one page does not hold."""
    if not 1 <= results <= MOST_RESULTS:
        raise InputError(f"{results} results to view; expected 1 to {MOST_RESULTS}")


@dataclass(frozen=True, repr=False)
class Viewer:
    """A page that a notebook shows in its cell."""

    html: str
    height: int = 600  # pixels, in a notebook

    def __repr__(self) -> str:
        return f"Viewer(a page of {len(self.html) / 1e6:.1f} MB; a notebook shows it, .save(path) writes it)"

    def save(self, path: str | Path) -> None:
        """Write the page to a file that opens in any browser, offline. Raises OutputError."""
        with writing(path) as temporary:
            temporary.write_text(self.html, encoding="utf-8")

    def _repr_html_(self) -> str:
        style = f"width: 100%; height: {self.height}px; border: 0"
        return f'<iframe srcdoc="{html.escape(self.html)}" style="{style}" allow="fullscreen"></iframe>'


def _page(title: str, scenes: list[dict[str, Any]]) -> str:
    packed = _Arrays()
    results = [packed.described(scene) for scene in scenes]
    data = json.dumps({"results": results, "arrays": packed.text()}, allow_nan=False)
    script = _script()
    parts = {
        "TITLE": html.escape(title),
        "STYLE": _client("style.css"),
        "HASH": base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        "DATA": data.replace("<", "\\u003c"),  # no text of a result ends the script element
        "SCRIPT": script,
    }
    return re.sub(r"\$(TITLE|STYLE|HASH|DATA|SCRIPT)\b", lambda match: parts[match[1]], _client("page.html"))


@cache
def _client(name: str) -> str:
    return (files("vggtjax.results.viewer") / "client" / name).read_text(encoding="utf-8")


@cache
def _script() -> str:
    body = "\n".join(_client(f"{name}.js") for name in _SCRIPTS)
    return f'"use strict";\n(() => {{\n{body}}})();\n'


class _Arrays:
    """Collects the arrays of a page in one run of bytes."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._length = 0

    def described(self, value: Any) -> Any:
        """Return a tree in which every array is replaced by its type, start and length, as client/data.js reads it."""
        if isinstance(value, dict):
            return {name: self.described(entry) for name, entry in value.items()}
        if isinstance(value, list | tuple):
            return [self.described(entry) for entry in value]
        if isinstance(value, float):  # JSON has no infinity
            return float(np.clip(np.nan_to_num(value), -_FARTHEST, _FARTHEST))
        if not isinstance(value, np.ndarray):
            return value
        part = np.ascontiguousarray(value, value.dtype.newbyteorder("<")).tobytes()
        start = self._length
        part += bytes(-len(part) % 4)  # every array starts where any type may
        self._parts.append(part)
        self._length += len(part)
        return {"type": value.dtype.name, "start": start, "length": value.size}

    def text(self) -> str:
        return base64.b64encode(zlib.compress(b"".join(self._parts), 6)).decode()
