"""What two runs of a command must share: the content of a file without its times; half-written files are told apart."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from PIL import Image
from safetensors.numpy import load_file

BROKEN = "half-written"
Files = dict[str, str]  # names below a folder, with those of folders -> digests
_TIMES = {"seconds", "render_share"}  # keys of JSON objects, and columns of tables
_TIMES_OF_PAGES = re.compile(rb"<h2>Time</h2>.*?</table>|\d+\.\d+ s\b|width: \d+\.\d+%", re.DOTALL)


def files_below(folder: Path) -> Files:
    """Return the files and folders below a folder, hidden ones too, with digests of what is in the files."""
    return {str(path.relative_to(folder)): _content(path) for path in sorted(folder.rglob("*"))}


def _content(path: Path) -> str:
    """Return a digest of a file without its times, "" for a folder, and `BROKEN` for a file that cannot be read."""
    if not path.is_file():
        return ""
    read = _WITHOUT_TIMES.get(path.suffix, Path.read_bytes)
    try:
        return hashlib.sha256(read(path)).hexdigest()
    except Exception:  # each library has its own errors for a file that ends early
        return BROKEN


def _json(path: Path) -> bytes:
    def kept(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: kept(own) for key, own in value.items() if key not in _TIMES}
        return [kept(own) for own in value] if isinstance(value, list) else value

    return json.dumps(kept(json.loads(path.read_text(encoding="utf-8")))).encode()


def _csv(path: Path) -> bytes:
    heading, *rows = csv.reader(io.StringIO(_ending(path, b"\n").decode()))
    columns = [number for number, name in enumerate(heading) if name not in _TIMES]
    return json.dumps([[row[number] for number in columns] for row in (heading, *rows)]).encode()


def _picture(path: Path) -> bytes:
    """Return a picture; of the plot of a training run, whose axis is the time, the size alone."""
    data = _ending(path, b"IEND\xaeB`\x82")
    with Image.open(path) as image:
        image.load()
        return repr(image.size).encode() if path.name == "metrics.png" else data


def _ending(path: Path, end: bytes) -> bytes:
    data = path.read_bytes()
    if not data.endswith((end, end + b"\n")):
        raise ValueError(f"{path} ends early")
    return data


def _weights(path: Path) -> bytes:
    load_file(path)
    return path.read_bytes()


def _arrays(path: Path) -> bytes:
    with path.open("rb") as file, zipfile.ZipFile(file) as archive:
        if (name := archive.testzip()) is not None:
            raise ValueError(f"{name} in {path} is damaged")
    return path.read_bytes()


_WITHOUT_TIMES: dict[str, Callable[[Path], bytes]] = {
    ".json": _json,
    ".csv": _csv,
    ".html": lambda path: _TIMES_OF_PAGES.sub(b"", _ending(path, b"</html>")),
    ".png": _picture,
    ".safetensors": _weights,
    ".npz": _arrays,
}
