"""What a command prints: its help, and names of files that forge no line and send no control characters."""

import errno
import logging
import os
import re
import subprocess
import sys
import warnings
from functools import partial

import pytest
from PIL import Image

from vggtjax.interface.commands import main as cli
from vggtjax.interface.commands.report import Report


def test_names_of_files_forge_no_lines(tmp_path, capsys, monkeypatch):
    path = tmp_path / "evil\x1b]0;title\x07\nvggtjax: all is well.safetensors"
    path.write_bytes(b"damaged")
    shown = f"{tmp_path}/evil?]0;title? vggtjax: all is well.safetensors"

    def printed(*arguments: str) -> tuple[str, list[str]]:
        with monkeypatch.context() as patch:
            patch.setattr(logging.root, "handlers", [])  # as in a process of its own
            assert cli.main(arguments) == 2
        out, err = capsys.readouterr()
        assert all(letter == "\n" or letter.isprintable() for letter in out + err)
        return out, err.splitlines()

    _, (failed,) = printed("info", str(path))
    assert failed.startswith(f"vggtjax: {shown} ")

    def command() -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("always")
            warnings.warn(f"{path} is odd", stacklevel=1)
        logging.getLogger("vggtjax").error("%s", "x" * 5000, exc_info=ValueError(str(path)))
        Report().note(f"{path} is noted")
        Report().line(f"{path} is printed")
        raise FileNotFoundError(errno.ENOENT, "no such file", str(path))

    monkeypatch.setitem(cli.COMMANDS, "scenes", cli.COMMANDS["scenes"]._replace(run=command))
    out, (odd, long, *traceback, noted, failed) = printed("scenes")
    assert odd == f"vggtjax: {shown} is odd"
    assert len(long) < 500
    assert traceback[0].startswith("ValueError: ")
    assert noted == f"{shown} is noted"
    assert failed == f"vggtjax: {shown}: no such file"
    assert out == f"{shown} is printed\n"

    with pytest.raises(SystemExit, match="2"):
        cli.main(["info", f"--{path.name}"])
    out, err = capsys.readouterr()
    assert all(letter == "\n" or letter.isprintable() for letter in out + err)


@pytest.mark.parametrize("code", ["cp1252", "ascii", "shift_jis"])
def test_output_in_a_code_page_without_the_letters_of_a_folder(tmp_path, code):
    """As on Windows, where output goes to a file: the work is done, and letters that the file cannot hold are "?"."""
    folder = tmp_path / "Видео-写真-é"
    folder.mkdir()
    Image.new("RGB", (64, 48), "teal").save(folder / "a.png")
    environment = os.environ | {"PYTHONIOENCODING": code, "PYTHONUTF8": "0"}
    run = partial(subprocess.run, capture_output=True, env=environment, timeout=120)
    told = run([sys.executable, "-m", "vggtjax", "info", str(folder)])
    assert told.returncode == 0, told.stderr
    assert folder.name.encode(code, "replace") in told.stdout
    missing = run([sys.executable, "-m", "vggtjax", "info", f"{folder}-нет"])
    assert (missing.returncode, b"Traceback" in missing.stderr) == (2, False)


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
