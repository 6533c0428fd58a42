"""The page of a batch: a card per clip, with a link to its report, written anew while clips are finished."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from vggtjax.errors import OutputError, ResultError, one_line
from vggtjax.options import METHODS
from vggtjax.pipeline.batch.destination import PAGE_NAME, Destination, LocalFolder
from vggtjax.pipeline.batch.recipe import ClipOutcome
from vggtjax.results.archive import ARCHIVE_NAME, is_result
from vggtjax.results.report import REPORT_NAME
from vggtjax.storage.arrays import read_arrays
from vggtjax.storage.markup import relative_link, render, write_page
from vggtjax.storage.writing import writing

_MOST_CARDS = 2000  # of results; more make a page that no browser shows well
_SHORT, _REST = 0.05, 20  # seconds that a page is written in at once, and how many times as long a pause follows longer
_PICTURES = ("preview/card.webp", "preview/sheet.png")  # the first that a clip's folder has is shown
_TARGETS = (REPORT_NAME, "preview/sheet.png", ARCHIVE_NAME)  # the first that a clip's folder has is linked to

logger = logging.getLogger(__name__)


class ContactPage:
    """The page of the batch in the folder `out`, where `clips` are to be reconstructed.

    Results that earlier runs have left in the folder have cards too, up to a number. A page that cannot be written is
    logged as a warning: the results are worth more.
    """

    def __init__(self, out: Path, clips: int) -> None:
        self._out, self._clips, self._told = out, clips, 0
        self._cards: dict[str, dict[str, Any]] = {}
        self._failures: dict[str, str] = {}
        self._results: set[str] = set()
        self._next = 0.0
        found = sorted(entry.name for entry in os.scandir(out) if entry.is_dir() and not entry.name.startswith("."))
        for name in found:
            if is_result(out / name / ARCHIVE_NAME):
                self._count(name)
        self.write()

    def add(self, name: str, failure: str | None = None) -> None:
        """Tell that a clip is finished, or why it failed, and write the page."""
        self._told += 1
        if failure is not None:
            self._failures[name] = failure
        elif name not in self._results:
            self._count(name)
        if time.monotonic() >= self._next:
            self.write()

    def _count(self, name: str) -> None:
        self._results.add(name)
        if len(self._cards) < _MOST_CARDS:
            self._cards[name] = _card(self._out, name)

    def write(self) -> None:
        """Write the page. After a long page `add` does not write for a while."""
        started = time.monotonic()
        try:
            with writing(self._out / PAGE_NAME) as temporary:
                write_page(temporary, self._text())
        except OutputError as error:
            logger.warning("%s", error)
        taken = time.monotonic() - started
        self._next = started + (taken * _REST if taken > _SHORT else 0)

    def _text(self) -> str:
        counts = [f"{len(self._results)} clip{'' if len(self._results) == 1 else 's'}"]
        counts += [f"{len(self._failures)} failed"] if self._failures else []
        left = self._clips - self._told
        counts += [f"{left} to come"] if left else []
        if max(len(self._results), len(self._failures)) > _MOST_CARDS:
            counts.append(f"of which {_MOST_CARDS} are shown")
        return render(
            "pipeline/batch/contact.html",
            title=f"{counts[0]}: vggtjax",
            counts=", ".join(counts),
            failures=dict(islice(self._failures.items(), _MOST_CARDS)),
            cards=[self._cards[name] for name in sorted(self._cards)],
        )


@contextmanager
def contact_page(place: Destination, clips: int) -> Iterator[Callable[[ClipOutcome], None]]:
    """Keep the page of a batch while the body runs, which tells the outcomes; a folder at a URL has no page."""
    if not isinstance(place, LocalFolder):
        yield lambda outcome: None
        return
    contact = ContactPage(place.path, clips)

    def tell(outcome: ClipOutcome) -> None:
        contact.add(outcome.name, outcome.reason if outcome.status == "failed" else None)

    try:
        yield tell
    finally:
        contact.write()


def _card(out: Path, name: str) -> dict[str, Any]:
    folder = out / name
    picture, target = (next((n for n in names if (folder / n).is_file()), None) for names in (_PICTURES, _TARGETS))
    try:
        told = _told(folder / ARCHIVE_NAME)
    except ResultError as error:
        told = f"cannot be read: {one_line(str(error))}"
    return {
        "name": name,
        "picture": relative_link(f"{name}/{picture}") if picture else None,
        "link": relative_link(f"{name}/{target or ARCHIVE_NAME}"),
        "told": told,
    }


def _told(path: Path) -> str:
    """Return what a card tells of a clip. Raises ResultError for a broken archive."""
    arrays = read_arrays(path, ["dynamic_mask", "valid_box", "method"])
    for name, kinds, axes in (("dynamic_mask", "b", 3), ("valid_box", "iu", 2), ("method", "U", 0)):
        array = arrays.get(name)
        if array is None or array.dtype.kind not in kinds or array.ndim != axes:
            found = "nothing" if array is None else f"{array.dtype} {array.shape}"
            raise ResultError(f"its {name} is {found}; expected that of a saved result")
    mask, box = arrays["dynamic_mask"], arrays["valid_box"].astype(np.float64)
    frames, height, width = mask.shape
    if box.shape[1] != 4:
        raise ResultError(f"its valid_box has the shape {box.shape}; expected that of a saved result")
    pictured = max(float(((box[:, 2] - box[:, 0]) * (box[:, 3] - box[:, 1])).sum()), 1.0)
    size = f"{frames} frame{'' if frames == 1 else 's'} of {width} x {height} pixels"
    method = one_line(str(arrays["method"].item()), 60)
    makes_none = method in METHODS and not METHODS[method].needs_second_pass and not mask.any()
    return f"{size}, {'' if makes_none else f'{mask.sum() / pictured:.1%} moving, '}{method}"
