"""`vggtjax COMMAND --help`: tyro's page, in which every option has a text and shows its values."""

import re

import pytest

from vggtjax.interface.commands import main as cli


@pytest.mark.parametrize("width", [80, 120])
@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_option_shows_its_values_and_what_it_does(name, width, capfd, monkeypatch):
    """Of capsys, whose encoding is called UTF-8 and not utf-8, tyro expects no boxes."""
    monkeypatch.setenv("COLUMNS", str(width))
    for flag in ("--help", "-h"):
        assert cli.main([name, flag]) == 0
    page = capfd.readouterr().out
    boxed = [line for line in page.splitlines() if line.startswith(("╭", "│"))]  # paragraphs are left to the terminal
    assert max(map(len, boxed)) <= width
    assert f"usage: vggtjax {name} " in page
    assert not re.search(r"--\S+ STR\b", page)
    options = [option.split("╰")[0] for option in re.split(r"^│ (?=-)", page, flags=re.MULTILINE)[1:]]
    assert len(options) > 1
    for option in options:  # its text stands behind spaces, beside the flag or below a long one
        assert re.search(r"\S {2,}[^│\s]", option), option


def test_format_has_one_meaning(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    for name in ("reconstruct", "batch", "view", "render", "import", "evaluate"):
        assert cli.main([name, "--help"]) == 0
        text = re.sub(r"[│\s]+", " ", capsys.readouterr().out)
        assert re.search(r"--format \{(vggtjax,)?vggt4d(,monst3r,[a-z0-9,]+)?\}", text), name
        assert "the program whose files the folder" in text, name
