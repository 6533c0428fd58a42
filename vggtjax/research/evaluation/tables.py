"""The means of an evaluation as tables: CSV, Markdown and LaTeX, in the column order of the paper's tables."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from vggtjax.errors import one_line
from vggtjax.research.evaluation.metrics.camera_pairs import THRESHOLDS
from vggtjax.research.evaluation.records import Record
from vggtjax.storage.markdown import markdown_table


class Column(NamedTuple):
    """A metric as a column."""

    group: str
    metric: str
    heading: str
    better: str  # "lower" or "higher"; "" if neither
    form: str = ".3f"


def _of_tracks(kind: str, words: str) -> tuple[Column, ...]:
    names = {"apd": "APD", "aj": "AJ", "oa": "OA", "world_apd": "world APD", "sim3_apd": "Sim(3) APD"}
    shares = [Column("Tracks", f"{kind}_{key}", f"{words} {name}", "higher") for key, name in names.items()]
    names = {"world_epe": "world EPE", "sim3_epe": "Sim(3) EPE"}
    return (*shares, *(Column("Tracks", f"{kind}_{key}", f"{words} {name}", "lower") for key, name in names.items()))


# Tables 1 and 2 of the paper first: points, then cameras; then masks, video depth and uncertainty.
COLUMNS = (
    Column("Point clouds", "accuracy_mean", "Acc. mean", "lower"),
    Column("Point clouds", "accuracy_median", "Acc. median", "lower"),
    Column("Point clouds", "completeness_mean", "Comp. mean", "lower"),
    Column("Point clouds", "completeness_median", "Comp. median", "lower"),
    Column("Point clouds", "distance_paired_mean", "Paired mean", "lower"),
    Column("Point clouds", "distance_paired_median", "Paired median", "lower"),
    Column("Point clouds", "distance_chamfer_mean", "Chamfer mean", "lower"),
    Column("Point clouds", "distance_chamfer_median", "Chamfer median", "lower"),
    Column("Cameras", "ate", "ATE", "lower"),
    Column("Cameras", "rte", "RTE", "lower"),
    Column("Cameras", "rre", "RRE", "lower"),
    *(Column("Cameras", f"auc_{limit}", f"AUC@{limit}", "higher") for limit in THRESHOLDS),
    Column("Dynamic masks", "j_mean", "J mean", "higher"),
    Column("Dynamic masks", "j_recall", "J recall", "higher"),
    Column("Dynamic masks", "f_mean", "F mean", "higher"),
    Column("Dynamic masks", "f_recall", "F recall", "higher"),
    Column("Dynamic masks", "j_pooled", "J pooled", "higher"),
    Column("Dynamic masks", "f_pooled", "F pooled", "higher"),
    Column("Dynamic masks", "saliency_auc", "Saliency AUC", "higher"),
    Column("Video depth", "abs_rel", "AbsRel", "lower"),
    Column("Video depth", "rmse", "RMSE", "lower"),
    Column("Video depth", "delta1", "d < 1.25", "higher"),
    Column("Uncertainty", "ause", "AUSE", "lower"),
    Column("Uncertainty", "nll", "NLL", "lower", ".2f"),
    Column("Uncertainty", "nll_calibrated", "NLL calibrated", "lower", ".2f"),
    Column("Uncertainty", "ece", "ECE", "lower"),
    Column("Uncertainty", "ece_calibrated", "ECE calibrated", "lower"),
    *_of_tracks("tracks", "Tracks"),
    *_of_tracks("dense", "Points along tracks"),
)
ARROWS = {"lower": "↓", "higher": "↑", "": ""}
_LATEX_ARROWS = {"lower": r" $\downarrow$", "higher": r" $\uparrow$", "": ""}


def shown_columns(means: Mapping[str, Mapping[str, float]]) -> list[Column]:
    """Return the columns in which at least one method has a value."""
    return [column for column in COLUMNS if any(column.metric in row for row in means.values())]


def grouped(columns: Sequence[Column]) -> dict[str, list[Column]]:
    """Return columns by protocol."""
    return {name: [c for c in columns if c.group == name] for name in dict.fromkeys(c.group for c in columns)}


def cell(row: Mapping[str, float], column: Column) -> str:
    """Return a value as text; a missing value is a dash."""
    return format(row[column.metric], column.form) if column.metric in row else "-"


def best(means: Mapping[str, Mapping[str, float]], column: Column) -> set[str]:
    """Return the best methods of a column by the digits shown; none if all are equal."""
    values = {method: float(cell(row, column)) for method, row in means.items() if column.metric in row}
    if len(set(values.values())) < 2 or not column.better:
        return set()
    bound = min(values.values()) if column.better == "lower" else max(values.values())
    return {method for method, value in values.items() if value == bound}


def markdown(means: Mapping[str, Mapping[str, float]]) -> str:
    """Return the means as a Markdown table, the best of each column in bold."""
    columns = shown_columns(means)
    headings = [f"{column.heading} {ARROWS[column.better]}".strip() for column in columns]
    rows = [
        [
            _plain(method),
            *(f"**{cell(row, c)}**" if method in best(means, c) else cell(row, c) for c in columns),
            str(failed(row)),
        ]
        for method, row in means.items()
    ]
    return markdown_table(["Method", *headings, "Failed"], rows)


def latex(means: Mapping[str, Mapping[str, float]]) -> str:
    """Return the means as a LaTeX tabular (booktabs), the best of each column in bold."""
    columns = shown_columns(means)
    lines = [
        r"\begin{tabular}{l" + "c" * (len(columns) + 1) + "}",
        r"\toprule",
        "Method & " + " & ".join(_tex(c.heading) + _LATEX_ARROWS[c.better] for c in columns) + r" & Failed \\",
        r"\midrule",
    ]
    for method, row in means.items():
        cells = [rf"\textbf{{{cell(row, c)}}}" if method in best(means, c) else cell(row, c) for c in columns]
        lines.append(" & ".join([_tex(method), *cells, failed(row)]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def comma_separated(records: Sequence[Record]) -> str:
    """Return every record as a line: sequence, method, status, all metrics in full, and the reason of a failure."""
    metrics = list(dict.fromkeys(metric for record in records for metric in record.metrics))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["sequence", "method", "status", "frames", *metrics, "reason"])
    for record in records:
        values = [record.metrics.get(metric, "") for metric in metrics]
        names = [_inert(record.name), _inert(record.method)]
        writer.writerow([*names, record.status, record.frames, *values, _inert(record.reason)])
    return text.getvalue()


def failed(row: Mapping[str, float]) -> str:
    """Return the number of failed sequences of all sequences."""
    return f"{int(row['failed'])} of {int(row['sequences'] + row['failed'])}"


def _plain(text: str) -> str:
    return one_line(text).replace("\\", "\\\\")


def _inert(text: str) -> str:
    """Return text that spreadsheets do not read as a formula."""
    return f"'{text}" if text[:1] in ("=", "+", "-", "@") else text


def _tex(text: str) -> str:
    special = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": "$<$", ">": "$>$"}
    return "".join(special.get(c, f"\\{c}" if c in "&%$#_{}" else c) for c in text)
