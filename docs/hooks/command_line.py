"""The reference of the command line, made at build time of the help of every command."""

from __future__ import annotations

import io
import os
from contextlib import redirect_stdout

from vggtjax.interface.commands.main import COMMANDS, overview, print_help

MARK = "HELP OF EVERY COMMAND"  # in place of what plain Markdown shows: site.py
_WIDTH = "100"


def on_page_markdown(markdown: str, **_: object) -> str:
    """Put the help of every command where a page has the mark."""
    return markdown.replace(MARK, _every_command()) if MARK in markdown else markdown


def _every_command() -> str:
    """Return the overview of the commands, and a section for each."""
    os.environ["COLUMNS"] = _WIDTH
    return "\n\n".join([f"```text\n{overview(COMMANDS)}```", *map(_section, COMMANDS)])


def _section(name: str) -> str:
    """Return the help of one command in Markdown."""
    with redirect_stdout(io.StringIO()) as text:
        print_help(name)
    return f"## vggtjax {name}\n\n```text\n{text.getvalue().strip()}\n```"
