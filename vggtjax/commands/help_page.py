"""The page of `vggtjax COMMAND --help`: what tyro says of the options, in groups and at the terminal's width."""

from __future__ import annotations

import re
from collections.abc import Iterator
from textwrap import wrap
from typing import NamedTuple

TYRO_WIDTH = 128  # of the text that is read; in wider terminals tyro sets groups side by side
_FIRST = ("--out", "--model")
_ORDER = ("arguments", "options", "input", "model", "method", "output", "limits")  # others stand behind the method's
_INDENT = 18  # of the texts of options
_BOX = re.compile(r"│ (.*?) *│")
_HINT = re.compile(r"(.*?)((?: \((?:default|required)[^()]*\))?)", flags=re.DOTALL)


class Group(NamedTuple):
    """Options that stand together: a title, a line about them, and rows of (flag, text)."""

    title: str
    about: str
    rows: list[tuple[str, str]]


class Help(NamedTuple):
    """The help of a command."""

    usage: str
    about: list[str]  # paragraphs
    groups: list[Group]


def read_help(text: str) -> Help:
    """Return what a help text of tyro says: paragraphs whole, `--out` and `--model` in the first group of options."""
    usage, *about = re.split(r"\n\s*\n", text.split("╭")[0].strip())
    groups: list[Group] = []
    for line in text.splitlines():
        if line.startswith("╭"):
            groups.append(Group(line.strip("╭╮─ "), "", []))
        elif row := _BOX.fullmatch(line):
            _add(groups, row[1])
    return Help(" ".join(usage.split()), [" ".join(part.split()) for part in about], _in_order(groups))


def page(command: Help, width: int) -> str:
    """Return the page for a terminal of `width` columns."""
    lines = _wrapped(command.usage, width, subsequent=" " * 4)
    for paragraph in command.about:
        lines += ["", *_wrapped(paragraph, width)]
    for group in command.groups:
        lines += ["", *_wrapped(f"{group.title}: {group.about}" if group.about else group.title, width)]
        for flag, says in group.rows:
            lines += _row(flag, says, width)
    return "\n".join(lines) + "\n"


def _row(flag: str, says: str, width: int) -> Iterator[str]:
    """Yield the lines of an option: its text beside the flag, or below a long one."""
    indent = " " * _INDENT
    texts = _wrapped(says, width, first=indent, subsequent=indent)
    if len(flag) + 4 <= _INDENT and texts:
        yield f"  {flag}".ljust(_INDENT) + texts.pop(0)[_INDENT:]
    else:
        yield from _wrapped(flag, width, first="  ", subsequent="      ")
    yield from texts


def _wrapped(text: str, width: int, *, first: str = "", subsequent: str = "") -> list[str]:
    return wrap(text, max(width, 40), initial_indent=first, subsequent_indent=subsequent, break_on_hyphens=False)


def _add(groups: list[Group], row: str) -> None:
    """Add a row of a box: a rule below what the box is about, a flag, or more text of the last flag."""
    group = groups[-1]
    if row and set(row) == {"─"}:
        groups[-1] = Group(group.title, " ".join(part for pair in group.rows for part in pair if part), [])
    elif row.startswith(" ") and group.rows:
        flag, text = group.rows[-1]
        group.rows[-1] = (flag, f"{text} {row.strip()}".strip())
    elif row:
        flag, _, text = re.sub(r" {2,}", "\0", row, count=1).partition("\0")
        group.rows.append((flag, text))


def _in_order(groups: list[Group]) -> list[Group]:
    """Return the groups in the order of `_ORDER`, with what most calls need first, and without --help."""
    rows = {flag.split()[0]: (flag, text) for group in groups for flag, text in group.rows}
    first = [rows[name] for name in _FIRST if name in rows]
    ordered: list[Group] = []
    for title, about, options in groups:
        others = [(flag, text) for flag, text in options if flag.split()[0] not in (*_FIRST, "-h,")]
        kept = first + others if title == "options" else others
        name = "arguments" if title == "positional arguments" else title.removesuffix(" options")
        about = "" if about.removeprefix("the ") == name else about.removesuffix(".")
        ordered.append(Group(name, about, [(flag, _plain(text)) for flag, text in kept]))
    return sorted((group for group in ordered if group.rows), key=lambda group: _place(group.title))


def _place(title: str) -> int:
    return _ORDER.index(title if title in _ORDER else "method")


def _plain(says: str) -> str:
    """Return a text without the full stop of a single sentence."""
    body, hint = _HINT.fullmatch(says).groups()  # type: ignore[union-attr]
    return says if ". " in body else body.removesuffix(".") + hint
