"""The code blocks of the README and of the pages of docs/, and what pages say about them.

A block of "py" is a signature in the reference. A comment right before a block is a rule for it:
`<!-- not run: needs VGGT-1B -->`, with any reason, for Python that is only compiled; `<!-- run -->` for commands that
are run and not only parsed.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from textwrap import dedent
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.py"))
LANGUAGES = ("python", "sh", "text", "json", "toml", "bibtex", "csv", "py")
_FENCE = re.compile(r"^([ >]*)```([^\n]*)\n(.*?)^\1```", flags=re.MULTILINE | re.DOTALL)
_RULE = re.compile(r"<!-- (run|not run: [^>]*\S) -->$")


class Block(NamedTuple):
    """A code block, the line that it begins at, and its rule: "run", "not run: why" or "" for none."""

    language: str
    text: str
    line: int
    rule: str


def page_name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def blocks(page: Path) -> Iterator[Block]:
    """Yield the code blocks of a page, those in lists and tabs too."""
    text = page.read_text(encoding="utf-8")
    for fence in _FENCE.finditer(text):
        rule = _RULE.search(text[: fence.start()].rstrip())
        line = text[: fence.start()].count("\n") + 1
        yield Block(fence[2].strip(), dedent(fence[3]), line, rule[1] if rule else "")


def commands(block: Block) -> list[str]:
    """Return the commands of a block for a shell: lines without comments, joined where they end with a backslash."""
    joined = block.text.replace("\\\n", " ")
    lines = (re.sub(r"(^|\s)#.*", "", line).strip() for line in joined.splitlines())
    return [line for line in lines if line]
