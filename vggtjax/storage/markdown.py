"""Tables of Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def markdown_table(heading: Sequence[str], rows: Iterable[Sequence[str]], *, right: bool = False) -> str:
    """Return a table, a line for each row, with a line break at the end.

    Args:
        heading: of the columns.
        rows: a cell for each column; `|` in a cell is shown and ends none.
        right: columns but the first are aligned to the right, as numbers.
    """
    rule = ["---", *["---:" if right else "---"] * (len(heading) - 1)]
    lines = ([cell.replace("|", "\\|") for cell in line] for line in (heading, rule, *rows))
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
