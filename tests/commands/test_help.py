"""The page of `vggtjax COMMAND --help`: lines within the terminal, what most calls need first, whole texts."""

import re
from itertools import pairwise

import pytest

from vggtjax.commands import main as cli
from vggtjax.commands.help_page import page

WIDTHS = (80, 120)


@pytest.fixture(scope="module")
def helps():
    return {name: cli.command_help(name) for name in cli.COMMANDS}


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_lines_fit_and_texts_are_wrapped_anew(helps, name):
    """A line ends early only where the next word would not fit; the pages of all widths have the same words."""
    pages = {width: page(helps[name], width) for width in WIDTHS}
    for width, text in pages.items():
        lines = text.splitlines()
        assert max(map(len, lines)) <= width
        for line, following in pairwise(lines):
            if re.match(r" {18}\S", line) and re.match(r" {18}\S", following):
                assert len(line) + 1 + len(following.split()[0]) > width, line
    assert len({" ".join(text.split()) for text in pages.values()}) == 1


def test_out_and_model_stand_first(helps):
    for name, command in helps.items():
        flags = [flag.split()[0] for group in command.groups if group.title != "arguments" for flag, _ in group.rows]
        wanted = [flag for flag in ("--out", "--model") if flag in flags]
        assert flags[: len(wanted)] == wanted, name
        assert len(set(flags)) == len(flags), name
    assert [row[0].split()[0] for row in helps["reconstruct"].groups[1].rows] == ["--out", "--model"]


def test_groups(helps):
    titles = ["arguments", "options", "input", "model", "method", "known cameras and scale", "output", "limits"]
    assert [group.title for group in helps["reconstruct"].groups] == titles
    assert {"input", "model", "method", "output", "limits"} <= {group.title for group in helps["batch"].groups}


def test_format_has_one_meaning_and_choices_show_their_values(helps):
    found = {
        name: (flag, text)
        for name, command in helps.items()
        for group in command.groups
        for flag, text in group.rows
        if flag.startswith("--format")
    }
    assert set(found) == {"reconstruct", "batch", "view", "render", "import", "evaluate"}
    for flag, text in found.values():
        assert re.fullmatch(r"--format \{(vggtjax,)?vggt4d(,monst3r,[a-z0-9,]+)?\}", flag)
        assert text.startswith("the program whose files the folder")
    metavars = [flag for command in helps.values() for group in command.groups for flag, _ in group.rows]
    assert [flag for flag in metavars if flag.split()[-1].strip("[]") == "STR"] == []


@pytest.mark.parametrize("width", WIDTHS)
def test_the_command_prints_it_at_the_width_of_the_terminal(helps, width, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(width))
    for flag in ("--help", "-h"):
        assert cli.main(["render", flag]) == 0
        assert capsys.readouterr().out == page(helps["render"], width)
