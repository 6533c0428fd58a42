"""The page of `vggtjax --help`: the commands in the order of use, a line each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import groupby
from typing import NamedTuple


class Command(NamedTuple):
    """A row of the table of commands, whose groups stand together."""

    run: Callable[..., int | None]  # an exit code other than 0; tyro makes its flags and its help
    group: str  # its title on the page
    says: str  # its line on the page


def overview(commands: Mapping[str, Command]) -> str:
    """Return the page."""
    width = max(map(len, commands))
    page = ["usage: vggtjax COMMAND ...", "", "4-D reconstruction of monocular video of a moving world.", ""]
    for title, rows in groupby(commands.items(), key=lambda row: row[1].group):
        page += [title, *(f"  {name:<{width}}  {command.says}" for name, command in rows), ""]
    page += ["vggtjax COMMAND --help tells the options of a command; --version prints the version.", ""]
    return "\n".join(page)
