"""The reference of the command line, made at build time of what `vggtjax COMMAND --help` prints."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

MARK = "<!-- the help of every command -->"
_WIDTH = "100"  # tyro sets groups side by side in wider terminals
_BOX = re.compile(r"│ (.*?) *│")


class Group(NamedTuple):
    """A box of the help: its title, a line about it, and rows of (flag, text)."""

    title: str
    about: str
    rows: list[tuple[str, str]]


def on_page_markdown(markdown: str, **_: object) -> str:
    """Put the help of every command where a page has the mark."""
    return markdown.replace(MARK, _every_command()) if MARK in markdown else markdown


def _every_command() -> str:
    """Return the overview of the commands, and a section for each."""
    from vggtjax.commands.main import COMMANDS

    with ThreadPoolExecutor() as pool:
        return "\n\n".join([f"```text\n{_help()}```", *pool.map(_section, COMMANDS)])


def _help(*command: str) -> str:
    """Return what `vggtjax COMMAND --help` prints, without colours."""
    environment = {**os.environ, "COLUMNS": _WIDTH, "NO_COLOR": "1"}
    line = [sys.executable, "-m", "vggtjax", *command, "--help"]
    return subprocess.run(line, check=True, capture_output=True, text=True, env=environment).stdout


def _section(command: str) -> str:
    """Return the help of one command in Markdown."""
    text = _help(command)
    usage, about = re.split(r"\n\s*\n", text.split("╭")[0].strip(), maxsplit=1)
    usage = " ".join(usage.removeprefix("usage: ").split())
    parts = [f"## vggtjax {command}", _plain(about), f"```text\n{usage}\n```"]
    return "\n\n".join([*parts, *filter(None, map(_list, groups(text)))])


def groups(text: str) -> list[Group]:
    """Return the boxes of a help text."""
    found: list[Group] = []
    for line in text.splitlines():
        if line.startswith("╭"):
            found.append(Group(line.strip("╭╮─ "), "", []))
        elif row := _BOX.fullmatch(line):
            _add(found, row[1])
    return found


def _add(found: list[Group], row: str) -> None:
    """Add a row of a box: a rule below what the box is about, a flag, or more text of the last flag."""
    group = found[-1]
    if row and set(row) == {"─"}:
        found[-1] = Group(group.title, " ".join(part for pair in group.rows for part in pair if part), [])
    elif row.startswith(" ") and group.rows:
        flag, text = group.rows[-1]
        group.rows[-1] = (flag, f"{text} {row.strip()}".strip())
    elif row:
        flag, _, text = re.sub(r" {2,}", "\0", row, count=1).partition("\0")
        group.rows.append((flag, text))


def _list(group: Group) -> str:
    """Return a box as a list of definitions; nothing for one that only tells of --help."""
    rows = [(flag, text) for flag, text in group.rows if flag != "-h, --help"]
    if not rows:
        return ""
    about = f": {_plain(group.about)}" if group.about else ""
    items = "\n\n".join(f"`{flag}`\n:   {_plain(text)}" for flag, text in rows)
    return f"**{group.title.capitalize()}**{about}\n\n{items}"


def _plain(text: str) -> str:
    """Return text whose characters do not mean anything in Markdown, but for backticks."""
    return re.sub(r"([*\[\]])", r"\\\1", text.replace("<", "&lt;"))
