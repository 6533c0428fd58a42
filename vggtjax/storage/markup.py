"""HTML pages of our own, from templates: every value in them is escaped, and nothing is loaded from elsewhere."""

from __future__ import annotations

import base64
import io
from functools import cache
from pathlib import Path
from urllib.parse import quote

import jinja2
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from vggtjax.errors import one_line

_QUALITY = 78  # of WebP


def render(template: str, **values: object) -> str:
    """Return the text of a template, named by its path in the package; the filter `line(300)` bounds a text."""
    return _environment().get_template(template).render(values)


@cache
def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("vggtjax", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["line"] = one_line
    return environment


def write_page(path: Path, text: str) -> None:
    """Write a page; a letter that UTF-8 cannot hold, as some file names have, becomes a question mark."""
    path.write_text(text, encoding="utf-8", errors="replace", newline="\n")


def webp(picture: UInt8[np.ndarray, "height width 3"], longest: int) -> bytes:
    """Return a picture as a WebP whose longer side is at most `longest` pixels."""
    image = Image.fromarray(picture)
    image.thumbnail((longest, longest), Image.Resampling.LANCZOS)
    file = io.BytesIO()
    image.save(file, "WEBP", quality=_QUALITY, method=4)
    return file.getvalue()


def data_uri(data: bytes) -> str:
    """Return a WebP's bytes as an address that holds them."""
    return f"data:image/webp;base64,{base64.b64encode(data).decode('ascii')}"


def relative_link(path: str) -> str:
    """Return the address of a file below the folder of the page, whatever letters its name has."""
    return "./" + "/".join(quote(part, safe="", errors="surrogateescape") for part in path.split("/"))
