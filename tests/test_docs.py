"""The README and the pages of docs/: their Python runs, their commands are understood, their links lead somewhere."""

from __future__ import annotations

import dataclasses
import functools
import re
import runpy
import shlex
import shutil
import tomllib
from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

import vggtjax
from tests.shared.documented import LANGUAGES, NOTEBOOKS, PAGES, ROOT, blocks, commands, page_name
from vggtjax.clips.truth import Truth
from vggtjax.interface.commands import main as cli
from vggtjax.options import Options
from vggtjax.pipeline.pretrained import embedded
from vggtjax.pipeline.pretrained.embedded import demo_clip
from vggtjax.pipeline.windows.plan import Windows
from vggtjax.results.saving import Saving

EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
TARGETS = re.findall(r"^([\w -]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)
BENCHMARKS = re.findall(
    r'^    "([\w-]+)": "[\w.:]+",$', (ROOT / "benchmarks" / "__main__.py").read_text(), flags=re.MULTILINE
)
FRAMES = 8
OTHERS = ("git", "hf", "ssh")  # programs that a reader has or does not have

pytestmark = [
    pytest.mark.filterwarnings("ignore:the field of view"),
    pytest.mark.filterwarnings("ignore:.*non-interactive:UserWarning"),
]


@pytest.fixture(scope="module")
def prepared(tmp_path_factory) -> Path:
    """Return a folder with what pages read: frames/ with the embedded clip, and clip.mp4 with its first frames."""
    folder = tmp_path_factory.mktemp("docs")
    pictures = (255 * demo_clip().images).round().astype(np.uint8)
    (folder / "frames").mkdir()
    with av.open(str(folder / "clip.mp4"), "w") as video:
        stream = video.add_stream("mpeg4", rate=8)
        stream.height, stream.width = pictures.shape[1:3]
        stream.pix_fmt = "yuv420p"
        for i, picture in enumerate(pictures):
            Image.fromarray(picture).save(folder / f"frames/{i:02}.png")
        for picture in pictures[:FRAMES]:
            video.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        video.mux(stream.encode())
    return folder


@pytest.fixture
def workplace(prepared, tiny_demo, empty_reports, tmp_path, monkeypatch) -> Path:
    """Return the current folder of a page: a copy of the prepared one.

    The pages run a tiny network, mostly on as many frames as one window of the page of long clips has, so that they
    share a program: their code does not depend on what a model knows or on how long a clip is.
    """
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.setattr(embedded, "demo_clip", lambda: Truth(*(array[::2][:FRAMES] for array in demo_clip())))
    folder = Path(shutil.copytree(prepared, tmp_path / "here"))
    monkeypatch.chdir(folder)
    return folder


def _with(language: str, rule: str = "") -> list[Path]:
    return [
        page
        for page in PAGES
        if any(block.language == language and block.rule.startswith(rule) for block in blocks(page))
    ]


def _notes_are_proofs(pages: list[Path]) -> list:
    notes = ROOT / "docs" / "research-notes"
    return [pytest.param(page, marks=pytest.mark.proof) if notes in page.parents else page for page in pages]


@pytest.mark.parametrize("page", _notes_are_proofs(_with("python")), ids=page_name)
def test_python_runs(page, workplace):
    names: dict = {"__name__": "__main__"}
    for block in blocks(page):
        if block.language == "python":
            code = compile("\n" * block.line + block.text, page_name(page), "exec")
            if not block.rule.startswith("not run"):
                exec(code, names)


@pytest.mark.proof
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=page_name)
def test_a_notebook_runs(notebook, tmp_path, monkeypatch):
    """With the embedded model, as a reader runs it."""
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(notebook), run_name="__main__")


@pytest.mark.parametrize("page", _with("sh"), ids=page_name)
def test_commands_are_understood(page, workplace, monkeypatch):
    called = []

    def recorder(name, command):
        return command._replace(run=functools.wraps(command.run)(lambda *_, **__: called.append(name)))

    monkeypatch.setattr(cli, "COMMANDS", {name: recorder(name, command) for name, command in cli.COMMANDS.items()})
    for line, program, arguments in _shell_commands(page):
        if program == "vggtjax":
            called.clear()
            assert cli.main(arguments) == 0, line
            assert called == arguments[:1] or arguments == ["--version"], line
        else:
            assert _is_known(program, arguments), line


@pytest.mark.proof
@pytest.mark.parametrize("page", _with("sh", "run"), ids=page_name)
def test_commands_run(page, prepared, tmp_path, monkeypatch):
    """With the embedded model, as a reader runs them."""
    monkeypatch.chdir(shutil.copytree(prepared, tmp_path / "here"))
    assert cli.main(["reconstruct", "clip.mp4", "--max-frames", "4", "--model", "demo", "--out", "result"]) == 0
    for line, program, arguments in _shell_commands(page, "run"):
        assert program == "vggtjax"
        assert cli.main(arguments) == 0, line


def _shell_commands(page: Path, rule: str = "") -> Iterator[tuple[str, str, list[str]]]:
    """Yield each command of a page's blocks, of those with a rule if one is given: where it is, program, arguments."""
    for block in blocks(page):
        for command in commands(block) if block.language == "sh" and block.rule.startswith(rule) else ():
            program, *arguments = shlex.split(command)
            yield f"{page_name(page)}, block of line {block.line}: {command}", program, arguments


def _is_known(program: str, arguments: list[str]) -> bool:
    """Tell whether a command other than vggtjax names an extra, a target, a benchmark or an example that there is."""
    if program == "pip":
        named = re.findall(r"\[([\w,]+)\]", " ".join(arguments))
        return arguments[0] == "install" and set(",".join(named).split(",")) <= {"", *EXTRAS}
    if program == "make":
        return {word for word in arguments if "=" not in word} <= {word for names in TARGETS for word in names.split()}
    if program.startswith("python"):
        if arguments[:2] == ["-m", "benchmarks"]:
            return arguments[2] in BENCHMARKS
        modules = ("tests.shared.make_checkpoint", "pytest", "venv")
        return (arguments[0] == "-m" and arguments[1] in modules) or (ROOT / arguments[0]).is_file()
    return program in (*OTHERS, ".", "cd")


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_blocks_and_links(page):
    assert [block for block in blocks(page) if block.language.split(" ")[0] not in LANGUAGES] == []
    text = page.read_text(encoding="utf-8")
    assert text.count("```") % 2 == 0
    links = re.findall(r"\]\(([^)#\s]+)", re.sub(r"```.*?```|`[^`\n]*`", "", text, flags=re.DOTALL))
    missing = [link for link in links if "://" not in link and not _leads_somewhere(page, link)]
    assert missing == []


def _leads_somewhere(page: Path, link: str) -> bool:
    return (page.parent / link).exists()


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_a_page_reads_as_plain_markdown(page):
    """Where it is not the site that shows it, no line of the site's own language stands in the way."""
    text = re.sub(r"```.*?```|`[^`\n]*`|<!--.*?-->", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert re.findall(r"^ *(?::::|!!!|\?\?\?|===|-+8<-).*|:material-[\w-]+:|\]\[", text, flags=re.MULTILINE) == []


@pytest.fixture(scope="module")
def site():
    return runpy.run_path(str(ROOT / "docs" / "hooks" / "site.py"))


def test_the_signatures_of_the_reference_are_those_of_the_code(site):
    """`make reference` writes them."""
    package = site["read_package"]()
    pages = sorted((ROOT / "docs" / "reference").glob("*.md"))
    stale = [
        page for page in pages if site["with_overview"](site["with_signatures"](page, package)) != page.read_text()
    ]
    assert stale == []
    captures = (ROOT / "docs" / "reference" / "captures.md").read_text()
    assert "**Arguments**\n\n- `path`: the capture's folder, or a .r3d file of Record3D.\n- `kind`: " in captures
    assert "**Errors**\n\n- `InputError`: an unknown kind, a folder of no kind" in captures
    assert 'method: MethodName = "4dvggt-d"' in (ROOT / "docs" / "reference" / "configuration.md").read_text()


def test_the_pictures_are_of_this_model():
    """`make pictures` makes them."""
    made_of = runpy.run_path(str(ROOT / "docs" / "pictures" / "concepts.py"))["made_of"]()
    assert (ROOT / "docs" / "pictures" / "made" / "made-of.txt").read_text() == made_of


def test_every_promise_names_a_test():
    named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", (ROOT / "docs" / "promises.md").read_text(encoding="utf-8"))
    missing = [name for file, name in named if f"def {name}(" not in (ROOT / file).read_text(encoding="utf-8")]
    assert len(named) > 20
    assert missing == []


def test_the_reference_has_every_option():
    hook = runpy.run_path(str(ROOT / "docs" / "hooks" / "command_line.py"))
    page = hook["_section"]("reconstruct")
    fields = [*dataclasses.fields(Options), *dataclasses.fields(Saving), *dataclasses.fields(Windows)]
    names = {"compute_dtype": "dtype"}
    flags = {f"--{names.get(field.name, field.name).replace('_', '-')}" for field in fields}
    assert {flag for flag in flags if not re.search(rf"{flag}(?![\w-])", page)} == set()
    assert "(required)" in page


def test_the_reference_has_every_public_name():
    names = set(dir(vggtjax)) - {"__version__"}
    assert len(names) <= 25
    pages = {path.name: path.read_text() for path in (ROOT / "docs" / "reference").glob("*.md")}
    shown = re.findall(r"<!-- site: ::: vggtjax\.(\w+) -->", "\n".join(pages.values()), flags=re.MULTILINE)
    assert names - set(shown) == set()
    levels = pages["index.md"].split("| level | names |")[1].split("\n\n")[0]
    assert sorted(re.findall(r"`(\w+)`", levels)) == sorted(names)


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120
