"""What the ladder's rows say: a table of errors, the change on one clip, and the change over many."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, get_args

from vggtjax.research.evaluation.ladder import LadderRow, MaskSource
from vggtjax.results.report import ErrorTable
from vggtjax.storage.writing import writing

_COLUMNS = {
    "abs_rel": ("AbsRel", "{:.3f}"),
    "abs_rel_static": ("static", "{:.3f}"),
    "abs_rel_dynamic": ("dynamic", "{:.3f}"),
    "rotation_error": ("rotation", "{:.2f}°"),
    "centre_error_ratio": ("centres", "{:.3f}"),
    "mask_jaccard": ("mask IoU", "{:.2f}"),
}
CAMERA_SCORES = ("rotation_error", "centre_error_ratio")
_WORDS: dict[MaskSource, str] = {"mined": "Masks as in the paper", "matches": "Masks by matches", "true": "True masks"}


class Change(NamedTuple):
    """How the second pass changes an error over many clips, as shares of the first pass's mean error."""

    mean: float
    error: float  # standard error of the mean over clips


class SecondPass(NamedTuple):
    """What the second pass changes over many clips."""

    clips: int
    changes: Mapping[MaskSource, Mapping[str, Change]]  # by source of the masks, then by field of LadderRow


def error_table(
    rows: Sequence[LadderRow], consistent: LadderRow | None = None, many: SecondPass | None = None
) -> ErrorTable:
    """Return the scores of one clip to print or to show on a page.

    Args:
        rows: of the clip; the table has a row per method and mask.
        consistent: of consistent depth; the last row.
        many: what the second pass changes over many such clips, said below the table.
    """
    listed = rows if consistent is None else [*rows, replace(consistent, method="consistent")]
    cells = [
        (
            row.method,
            row.mask_source or "-",
            *(
                "-" if (value := getattr(row, name)) is None else form.format(value)
                for name, (_, form) in _COLUMNS.items()
            ),
        )
        for row in listed
    ]
    lines = [second_pass_in_words(rows)]
    if many is not None:
        lines.append(many_in_words(many))
    first = next((row for row in rows if row.method == "vggt"), None)
    if consistent is not None and first is not None:
        words = _change_in_words(first, consistent)
        lines.append(f"Depth and cameras fitted to the clip's pixels, compared with the first pass: {words}.")
    note = "\n".join(lines) + (
        "\nAbsRel: of depth after one median scale. Rotation: mean, relative to the first "
        "frame. Centres: RMSE after Sim(3), in median depths. Mask: mined from the first pass as in the paper, by "
        "matches between its frames too, by the clip's pixels after the fit, or the true one."
    )
    return ErrorTable(("method", "mask", *(heading for heading, _ in _COLUMNS.values())), cells, note.lstrip())


def second_pass_in_words(rows: Sequence[LadderRow]) -> str:
    """Return what 4dvggt-d changes on one clip, compared with the first pass alone: a line for each source of masks.

    Rows of the other methods, and rows without scores, are not read.
    """
    first = next((row for row in rows if row.method == "vggt"), None)
    return "\n".join(
        f"{_WORDS[source]}, second pass on this clip: {_change_in_words(first, row)}."
        for source in get_args(MaskSource)
        for row in rows
        if first is not None and row.method == "4dvggt-d" and row.mask_source == source
        if None not in {getattr(scores, name) for scores in (first, row) for name in ("abs_rel", *CAMERA_SCORES)}
    )


def write_second_pass(path: Path, many: SecondPass) -> None:
    """Write a JSON file for `read_second_pass`."""
    with writing(path) as temporary:
        temporary.write_text(json.dumps(many._asdict(), indent=1) + "\n", "utf-8")


def read_second_pass(path: Path) -> SecondPass:
    """Return what `write_second_pass` wrote."""
    stored = json.loads(path.read_text("utf-8"))
    changes = {
        source: {name: Change(*change) for name, change in by_name.items()}
        for source, by_name in stored["changes"].items()
    }
    return SecondPass(stored["clips"], changes)


def many_in_words(many: SecondPass) -> str:
    """Return a sentence of what the second pass changes over many clips, in percent with standard errors."""

    def in_percent(name: str, by: Change) -> str:
        return f"{_COLUMNS[name][0]} by {100 * by.mean:+z.0f} ± {100 * by.error:.0f} %"

    by_source = ". ".join(
        f"{_WORDS[source]}: {', '.join(in_percent(*item) for item in changes.items())}"
        for source, changes in many.changes.items()
    )
    what = f"Over {many.clips} such clips the second pass changes the mean errors (± standard error; less is better)"
    return f"{what}. {by_source}."


def _change_in_words(first: LadderRow, second: LadderRow) -> str:
    def change(name: str) -> str:
        heading, form = _COLUMNS[name]
        before, after = getattr(first, name), getattr(second, name)
        if before is None or after is None:
            return f"{heading} unknown"
        word = "unchanged" if after == before else "better" if after < before else "worse"
        return f"{heading} {word}, {form.format(before)} -> {form.format(after)}"

    return "; ".join(map(change, (*CAMERA_SCORES, "abs_rel")))
