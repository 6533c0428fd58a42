"""Pages that read well as plain Markdown, in a checkout or a code host, and better on the site.

A block `<!-- site: TEXT -->...<!-- /site -->` shows its own text wherever Markdown is read, and TEXT on the site. In
the reference TEXT is a directive of mkdocstrings, and the block is a signature and its docstring, with arguments,
returns and errors as lists, made by `make reference`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import griffe
    from mkdocs.structure.pages import Page

DOCS = Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"<!-- site: (.*?) -->.*?<!-- /site -->", flags=re.DOTALL)
_DIRECTIVE = re.compile(r"<!-- site: ::: (\S+) -->.*?<!-- /site -->", flags=re.DOTALL)
EVERY_COMMAND = "HELP OF EVERY COMMAND"  # command_line.py puts it there
_WIDEST = 100  # columns of a signature in one line
_SECTIONS = {  # of a docstring, by griffe's names
    "parameters": "Arguments",
    "attributes": "Attributes",
    "returns": "Returns",
    "yields": "Yields",
    "raises": "Errors",
}
_SETTINGS = {  # of pages, which as front matter plain Markdown would show
    "index.md": {"hide": ["navigation", "toc"]},
    "reference/changes.md": {"search": {"exclude": True}},
}


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Put the site's text in place of what a plain reader sees, and the settings of a page (a hook of mkdocs)."""
    page.meta.update(_SETTINGS.get(page.file.src_uri, {}))
    markdown = re.sub(r"(notebooks/\w+)\.py\)", r"\1.md)", markdown)
    return BLOCK.sub(lambda found: found[1], markdown)


def with_signatures(page: Path, package: griffe.Module) -> str:
    """Return the text of a page of the reference, with every signature as the code has it."""
    return _DIRECTIVE.sub(lambda found: block(found[1], page, package), page.read_text(encoding="utf-8"))


def with_overview(text: str) -> str:
    """Return the text of a page with the overview that `vggtjax --help` prints, where it has a place for it."""
    from vggtjax.interface.commands.main import COMMANDS, overview

    shown = f"<!-- site: {EVERY_COMMAND} -->\n```text\n{overview(COMMANDS)}```\n<!-- /site -->"
    return re.sub(f"<!-- site: {EVERY_COMMAND} -->.*?<!-- /site -->", lambda _: shown, text, flags=re.DOTALL)


def read_package() -> griffe.Module:
    """Return the package as its source has it; nothing is imported."""
    import griffe

    root = DOCS.parent
    loader = griffe.GriffeLoader(search_paths=[root], docstring_parser="google", allow_inspection=False)
    package = loader.load("vggtjax", try_relative_path=False)
    loader.resolve_aliases()
    assert isinstance(package, griffe.Module)
    return package


def block(name: str, page: Path, package: griffe.Module) -> str:
    """Return what a plain reader sees of one name: its signature and docstring, and its file."""
    found: Any = package[name.removeprefix("vggtjax.")]
    found = found.final_target if found.is_alias else found
    source = found.filepath.relative_to(DOCS.parent).as_posix()
    here = "../" * len(page.relative_to(DOCS.parent).parent.parts)
    parts = [
        f'<!-- site: ::: {name} -->\n<a id="{name}"></a>\n\n### {found.name}',
        f"```py\n{_double_quoted(_signature(found))}\n```",
        *_sections(found),
        f"All of it: [{source}]({here}{source})\n<!-- /site -->",
    ]
    return "\n\n".join(filter(None, parts))


def _sections(found: Any) -> Iterator[str]:
    """Yield the texts of a docstring, and its lists: arguments or attributes, what is returned or yielded, errors."""
    for section in [] if found.docstring is None else found.docstring.parse("google", warnings=False):
        if section.kind.value == "text":
            yield section.value
        elif title := _SECTIONS.get(section.kind.value):
            yield f"**{title}**\n\n" + "\n".join(_item(section.kind.value, item) for item in section.value)


def _item(kind: str, item: Any) -> str:
    text = " ".join(item.description.split())
    name = item.annotation if kind == "raises" else getattr(item, "name", "")
    if kind in ("returns", "yields"):
        name = ""
    return f"- `{name}`: {text}" if name else f"- {text}"


def _double_quoted(text: str) -> str:
    """Return code with the quotes of the source, where griffe has changed them."""
    return text if '"' in text else text.replace("'", '"')


def _signature(found: Any) -> str:
    if found.is_attribute:
        value = f" = {found.value}" if found.value is not None and len(str(found.value)) < _WIDEST else ""
        return found.name + (f": {found.annotation}" if found.annotation else "") + value
    start = f"class {found.name}" if found.is_class else f"def {found.name}"
    parameters, returns = list(found.parameters), f" -> {found.returns}" if found.is_function and found.returns else ""
    fields = [f"    {name}: {a.annotation}" for name, a in found.attributes.items() if found.is_class and a.annotation]
    if found.is_class and not [p for p in parameters if p.name != "self"]:
        start += f"({', '.join(map(str, found.bases))})" if found.bases else ""
        return "\n".join([f"{start}:", *fields]) if fields else start
    words = list(_words(parameters))
    line = f"{start}({', '.join(words)}){returns}"
    return (
        line if len(line) <= _WIDEST else "\n".join([f"{start}(", *(f"    {word}," for word in words), f"){returns}"])
    )


def _words(parameters: list[Any]) -> Any:
    """Yield the parameters as they are written, with the marks between kinds."""
    kinds = [parameter.kind.value for parameter in parameters]
    for number, parameter in enumerate(parameters):
        if parameter.name == "self":
            continue
        kind, before = kinds[number], kinds[:number]
        if kind == "keyword-only" and not {"keyword-only", "variadic positional"} & set(before):
            yield "*"
        star = {"variadic positional": "*", "variadic keyword": "**"}.get(kind, "")
        note = f": {parameter.annotation}" if parameter.annotation else ""
        has_default = parameter.default is not None and not star
        yield f"{star}{parameter.name}{note}" + (f"{' = ' if note else '='}{parameter.default}" if has_default else "")
        if kind == "positional-only" and (number + 1 == len(kinds) or kinds[number + 1] != kind):
            yield "/"


def main() -> None:
    """Write the signatures of the reference, and the overview of the commands, anew."""
    package = read_package()
    for page in sorted((DOCS / "reference").glob("*.md")):
        page.write_text(with_overview(with_signatures(page, package)), encoding="utf-8")


if __name__ == "__main__":
    main()
