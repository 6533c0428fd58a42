"""HTML pages of our own, as trees of elements: every text in them is escaped, and nothing is loaded from elsewhere."""

from __future__ import annotations

import base64
import io
from functools import cache
from importlib.resources import files
from pathlib import Path
from urllib.parse import quote
from xml.etree.ElementTree import Element, tostring

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from vggtjax.errors import one_line

_QUALITY = 78  # of WebP


def element(tag: str, *children: Element | str | None, **attributes: object) -> Element:
    """Return an element. None among the children is left out; `class_` is class, and an underscore becomes a hyphen."""
    made = Element(tag, {name.strip("_").replace("_", "-"): str(value) for name, value in attributes.items()})
    for child in children:
        if isinstance(child, Element):
            made.append(child)
        elif child is not None and len(made):
            made[-1].tail = (made[-1].tail or "") + child
        elif child is not None:
            made.text = (made.text or "") + child
    return made


def page(title: str, *body: Element | None, pictures: str = "data:") -> str:
    """Return a whole page that runs no script and loads nothing from the network.

    Args:
        title: of the window.
        body: what the page shows.
        pictures: where pictures may come from, as a Content-Security-Policy says it.
    """
    policy = f"default-src 'none'; img-src {pictures}; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", http_equiv="Content-Security-Policy", content=policy),
        element("meta", name="color-scheme", content="light dark"),
        element("meta", name="generator", content="vggtjax"),
        element("title", one_line(title)),
        element("style", style()),
    )
    root = element("html", head, element("body", element("main", *body)), lang="en")
    return f"<!doctype html>\n{tostring(root, encoding='unicode', method='html')}\n"


def write_page(path: Path, text: str) -> None:
    """Write a page; a letter that UTF-8 cannot hold, as some file names have, becomes a question mark."""
    path.write_text(text, encoding="utf-8", errors="replace", newline="\n")


@cache
def style() -> str:
    """Return the style sheet of all pages, for light and dark, wide and narrow screens and paper."""
    return files("vggtjax.storage").joinpath("page.css").read_text(encoding="utf-8")


def table(rows: list[tuple[str, str | Element]], **attributes: object) -> Element:
    """Return a table of names and values."""
    return element(
        "table", *(element("tr", element("th", name), element("td", value)) for name, value in rows), **attributes
    )


def webp(picture: UInt8[np.ndarray, "height width 3"], longest: int) -> bytes:
    """Return a picture as a WebP whose longer side is at most `longest` pixels."""
    image = Image.fromarray(picture)
    image.thumbnail((longest, longest), Image.Resampling.LANCZOS)
    file = io.BytesIO()
    image.save(file, "WEBP", quality=_QUALITY, method=4)
    return file.getvalue()


def data_uri(data: bytes, kind: str = "image/webp") -> str:
    """Return a file's bytes as an address that holds them."""
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"


def relative_link(*parts: str) -> str:
    """Return the address of a file below the folder of the page, whatever letters its name has."""
    return "./" + "/".join(quote(part, safe="", errors="surrogateescape") for part in parts)
