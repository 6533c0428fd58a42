"""The files of an evaluation: results.json, results.csv, two tables, and a page with pictures."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import Any

from vggtjax.errors import InputError
from vggtjax.research.evaluation import tables
from vggtjax.research.evaluation.plots import draw_sequence
from vggtjax.research.evaluation.records import FOLDER, Record, Records, costs, safe_name, summary
from vggtjax.storage.json_values import read_json
from vggtjax.storage.markup import render
from vggtjax.storage.writing import check_free, writing

PLOT_FOLDER = "plots"
_MOST_BYTES = 2**28
NO_PLOTS = "plots are left out, as matplotlib is not installed: pip install -e '.[evaluate]' and run again"
NAMES = ("results.json", "results.csv", "table.md", "table.tex", "index.html", PLOT_FOLDER)


def can_plot() -> bool:
    """Return whether matplotlib is installed."""
    try:
        for name in ("matplotlib", "matplotlib.figure"):
            import_module(name)
    except ImportError:
        return False
    return True


def is_report(path: Path) -> bool:
    """Return whether a file is the results.json of an evaluation."""
    try:
        values = read_json(path, dict[str, Any], "evaluation", most_bytes=_MOST_BYTES)
    except InputError:
        return False
    return {"settings", "sequences", "mean"} <= set(values)


def check_report(out: Path, store: Records) -> None:
    """Make sure that `write_report` can write into `out`, before hours are spent.

    Raises:
        OutputError: the folder cannot be written, or holds files that are not of an evaluation.
    """
    replaced = is_report(out / "results.json") or store.exists()
    check_free(out, (*NAMES, FOLDER), replaced=replaced, what="evaluation")


def write_report(
    out: Path, records: Sequence[Record], store: Records, settings: Mapping[str, Any], *, warnings: Sequence[str] = ()
) -> None:
    """Write all files of an evaluation into `out`; without matplotlib there are no plots, which the page says.

    Args:
        out: folder.
        records: one per sequence and method.
        store: folder with their curves.
        settings: everything that the numbers depend on.
        warnings: sentences at the top of the page.
    """
    means = summary(records)
    values = {
        "settings": dict(settings),
        "sequences": [asdict(record) for record in records],
        "mean": means,
        "seconds": costs(records),
    }
    _write(out / "results.json", json.dumps(values, indent=2) + "\n")
    _write(out / "results.csv", tables.comma_separated(records))
    _write(out / "table.md", tables.markdown(means))
    _write(out / "table.tex", tables.latex(means))
    sequences = [
        _section(out, [r for r in records if r.name == name], store) for name in dict.fromkeys(r.name for r in records)
    ]
    seconds = values["seconds"]
    page = render(
        "research/evaluation/page.html",
        title=f"{settings['dataset']}: {', '.join(means)}",
        sequences=sequences,
        means=means,
        columns=tables.shown_columns(means),
        costs=seconds,
        stages=list(dict.fromkeys(stage for row in seconds.values() for stage in row)),
        settings=settings,
        warnings=[*warnings, *(() if can_plot() else (NO_PLOTS,))],
        tables=tables,
    )
    _write(out / "index.html", page)


def _section(out: Path, records: Sequence[Record], store: Records) -> dict[str, Any]:
    name = records[0].name
    good = [record for record in records if record.status == "ok"]
    folder = f"{PLOT_FOLDER}/{safe_name(name)}"
    curves = {record.method: store.curves(record) for record in good} if can_plot() else {}
    plots = draw_sequence(out / folder, curves)
    rows = {record.method: record.metrics for record in good}
    return {
        "name": name,
        "frames": records[0].frames,
        "failures": [record for record in records if record.status == "failed"],
        "notes": list(dict.fromkeys(note for record in good for note in record.notes)),
        "rows": rows,
        "columns": tables.shown_columns(rows),
        "plots": [{"file": f"{folder}/{file}", "title": title} for file, title in plots],
    }


def _write(path: Path, text: str) -> None:
    with writing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")  # a path may have any bytes
