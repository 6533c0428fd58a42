"""Names of pictures in an export: those of the source, but for names that not every system holds, one by one."""

from __future__ import annotations

import csv
import logging
import os
import re
import unicodedata
from collections.abc import Sequence
from itertools import chain, count, product
from pathlib import Path, PurePosixPath

from vggtjax.clips.media.images import ImageFiles
from vggtjax.clips.media.sampling import Source
from vggtjax.results.result import Result

WRITTEN = (".jpg", ".jpeg", ".png")  # as which pictures are written
TABLE = "renamed.csv"
_FORBIDDEN = re.compile(r'[<>:"/\\|?*]')  # of Windows
_RESERVED = re.compile(r"(?:con|prn|aux|nul|com[0-9¹²³]|lpt[0-9¹²³]|conin\$|conout\$) *(?:\..*)?", re.IGNORECASE)
_LONGEST = 200  # bytes of a name with its folders, so that systems hold it with a suffix more

logger = logging.getLogger(__name__)


def picture_names(result: Result, source: Source | None) -> list[str]:
    """Return the names of the frames' pictures with a suffix, as they are: no name is safe yet.

    They are those of the source's files, with the folders that not all of them share (none on several drives), where
    the files are .jpg or .png; else the frames' names and a suffix: .jpg for frames of a source, .png at the model's
    size.
    """
    suffix = ".png" if source is None else ".jpg"
    names = [f"{name}{suffix}" for name in result.frame_names]
    if not isinstance(source, ImageFiles):
        return names
    paths = [Path(os.path.abspath(path)) for path in source.paths]  # noqa: PTH100 -- links keep their names
    try:
        root = os.path.commonpath([path.parent for path in paths])
    except ValueError:  # files on several drives
        root = None
    files = iter(zip(source.frame_names, paths, strict=True))
    for number, frame in enumerate(result.frame_names):  # in the order of the source
        path = next((path for name, path in files if name == frame), None)
        if path is not None:
            place = Path(path.name) if root is None else path.relative_to(root)
            own = path.suffix if path.suffix.lower() in WRITTEN else suffix
            names[number] = place.with_name(f"{path.stem}{own}").as_posix()
    return names


def safe_names(names: Sequence[str], *, blanks: bool = True) -> list[str]:
    """Return names that every common file system holds beside each other, with / between folders; others are kept.

    Changed are those with letters that Windows forbids or that do not print, hidden, reserved and long ones, those that
    leave the folder, and those that differ from an earlier one in upper case, in the form of their letters (Unicode) or
    in the suffix alone. Without `blanks`, names with blank letters are changed, too.
    """
    taken: set[str] = set()
    kept: dict[str, bool] = {}
    for name in names:
        if name not in kept:
            kept[name] = _safe(name, blanks) == name and not _clashes(name, taken) and _take(name, taken)
    made = []
    for number, name in enumerate(names):
        if kept.pop(name, False):  # the first of equal names
            made.append(name)
            continue
        path = PurePosixPath(_safe(name, blanks))
        flat = PurePosixPath("_".join(path.parts))  # where a folder has the name of a picture
        own = f"_{number:06d}"
        ends = chain(product((path, flat), ("", own)), ((flat, f"{own}_{more}") for more in count()))
        tries = (str(place.with_name(f"{place.stem}{end}{place.suffix}")) for place, end in ends)
        new = next(text for text in tries if not _clashes(text, taken))
        _take(new, taken)
        made.append(new)
    return made


def say_renamed(folder: Path, old: Sequence[str], new: Sequence[str]) -> None:
    """Write the table of the names that were changed, and say how many in one line; nothing where none was."""
    changed = [(before, after) for before, after in zip(old, new, strict=True) if before != after]
    if not changed:
        return
    with (folder / TABLE).open("w", encoding="utf-8", errors="backslashreplace", newline="") as file:
        csv.writer(file).writerows([("name", "exported as"), *changed])
    before, after = changed[0]
    logger.warning(
        "%d of %d pictures have another name in the export, such as %s for %r; %s lists them",
        *(len(changed), len(old), after, before, TABLE),
    )


def _safe(name: str, blanks: bool) -> str:
    """Return a name without what a system forbids."""
    suffix = next((end for end in WRITTEN if name.lower().endswith(end)), "")
    end = name[len(name) - len(suffix) :]
    *folders, stem = name[: len(name) - len(suffix)].split("/")
    *folders, stem = (_part(part, blanks) for part in [*filter(None, folders), stem])
    room = _LONGEST - len(end)
    whole = "/".join([*folders, stem])
    if len(whole.encode()) > room:
        whole = stem.encode()[:room].decode(errors="ignore").rstrip(". ") or "_"
    return whole + end


def _part(part: str, blanks: bool) -> str:
    letters = (
        "_" if _FORBIDDEN.match(letter) or not letter.isprintable() or (letter.isspace() and not blanks) else letter
        for letter in part
    )
    text = "".join(letters)
    start, end = re.match(r"[. ]*", text)[0], re.search(r"[. ]*$", text)[0]  # pyright: ignore[reportOptionalSubscript]
    text = "_" * len(start) + text[len(start) : len(text) - len(end)] + "_" * len(end) if text.strip(". ") else "_"
    return f"_{text}" if _RESERVED.fullmatch(text) else text


def _marks(name: str) -> tuple[str, str, list[str]]:
    """Return what systems may tell a file by: its name, its name without the suffix; and its folders."""
    path = PurePosixPath(unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", name).casefold()))
    return f"file {path}", f"stem {path.with_suffix('')}", [str(folder) for folder in path.parents[:-1]]


def _clashes(name: str, taken: set[str]) -> bool:
    """Return whether a file has the name of another or of a folder, or a folder of it that of a file."""
    file, stem, folders = _marks(name)
    return not taken.isdisjoint({stem, file.replace("file", "folder", 1), *(f"file {folder}" for folder in folders)})


def _take(name: str, taken: set[str]) -> bool:
    file, stem, folders = _marks(name)
    taken.update((file, stem), (f"folder {folder}" for folder in folders))
    return True
