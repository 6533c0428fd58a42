"""The reference of the command line, made at build time of the help of every command."""

from __future__ import annotations

import re

from vggtjax.commands.help_page import Group
from vggtjax.commands.main import COMMANDS, command_help
from vggtjax.commands.overview import overview

MARK = "HELP OF EVERY COMMAND"  # in place of what plain Markdown shows: site.py


def on_page_markdown(markdown: str, **_: object) -> str:
    """Put the help of every command where a page has the mark."""
    return markdown.replace(MARK, _every_command()) if MARK in markdown else markdown


def _every_command() -> str:
    """Return the overview of the commands, and a section for each."""
    return "\n\n".join([f"```text\n{overview(COMMANDS)}```", *map(_section, COMMANDS)])


def _section(name: str) -> str:
    """Return the help of one command in Markdown."""
    usage, about, groups = command_help(name)
    parts = [f"## vggtjax {name}", *map(_plain, about), f"```text\n{usage.removeprefix('usage: ')}\n```"]
    return "\n\n".join([*parts, *map(_list, groups)])


def _list(group: Group) -> str:
    """Return a group as a list of definitions."""
    about = f": {_plain(group.about)}" if group.about else ""
    items = "\n\n".join(f"`{flag}`\n:   {_plain(text)}" for flag, text in group.rows)
    return f"**{group.title.capitalize()}**{about}\n\n{items}"


def _plain(text: str) -> str:
    """Return text whose characters do not mean anything in Markdown, but for backticks."""
    return re.sub(r"([*\[\]])", r"\\\1", text.replace("<", "&lt;"))
