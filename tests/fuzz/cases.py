"""One case: a copy of a reader's valid sample with one structural change, read under a limit of time and of memory."""

from __future__ import annotations

import os
import shutil
import signal
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

from tests.fuzz.changes.text import NAMES
from tests.fuzz.mutations import mutated
from tests.shared.high_water import reset_high_water
from vggtjax.errors import VggtjaxError
from vggtjax.storage.memory import process_bytes

MOST_SECONDS = 10.0
MOST_LETTERS = 500  # of a message
_MOST_RAW_LETTERS = 5000  # of a message before it is shortened
_TIMES = 2  # of the valid sample's memory a case may take


class Reader(NamedTuple):
    """A reader of strangers' files: how a valid sample is written into a folder, and how it is read."""

    name: str
    make: Callable[[Path], Path]  # returns what is read: a file or folder inside the given, empty folder
    read: Callable[[Path], object]
    slack: int = 48 * 2**20  # bytes that a case may take beyond twice what the valid sample takes


class Outcome(NamedTuple):
    """What a case came to: accepted, refused in a sentence, or found, which is a defect."""

    kind: str
    words: str
    bytes: int


class HangError(BaseException):
    """A case that took more than MOST_SECONDS; not an Exception, so that no reader catches it."""


class Sample:
    """The valid sample of a reader, and the memory that reading it takes."""

    def __init__(self, reader: Reader, folder: Path) -> None:
        self.reader = reader
        self._folder = folder / "sample"
        self._folder.mkdir(parents=True)
        self._read = reader.make(self._folder).relative_to(self._folder)
        self._scratch = folder / "case"
        first, second = (self.run(None) for _ in range(2))
        for outcome in (first, second):
            if outcome.kind != "accepted":
                raise ValueError(f"the valid sample of {reader.name} is {outcome.kind}: {outcome.words}")
        self.bytes = max(first.bytes, second.bytes)

    def run(self, seed: int | Path | None) -> Outcome:
        """Read a copy of the sample, changed as a seed says, or by the files of a folder; None leaves it valid."""
        shutil.rmtree(self._scratch, ignore_errors=True)
        shutil.copytree(self._folder, self._scratch, symlinks=True)
        if isinstance(seed, Path):
            shutil.copytree(seed, self._scratch, symlinks=True, dirs_exist_ok=True)
        elif seed is not None:
            change(self._scratch, Random(f"{self.reader.name} {seed}"))
        outcome = read(self.reader.read, self._scratch / self._read)
        if seed is not None and outcome.kind != "found" and outcome.bytes > _TIMES * self.bytes + self.reader.slack:
            words = f"took {outcome.bytes >> 20} MiB, the valid sample {self.bytes >> 20}; {outcome.words}"
            return outcome._replace(kind="found", words=words)
        return outcome

    def keep(self, seed: int, folder: Path) -> None:
        """Run a case again, and copy its files that are not those of the sample: the corpus takes them."""
        self.run(seed)
        for path in sorted(self._scratch.rglob("*")):
            same = self._folder / path.relative_to(self._scratch)
            if path.is_file() and not (same.is_file() and same.read_bytes() == path.read_bytes()):
                place = folder / path.relative_to(self._scratch)
                place.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, place)


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Yield a new folder, in memory where the system has such a place: cases write thousands of small files."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(prefix="vggtjax-fuzz-", dir=memory if memory.is_dir() else None) as folder:
        yield Path(folder)


def read(function: Callable[[Path], object], path: Path) -> Outcome:
    """Call a reader; every outcome but success and one good sentence is found."""
    before = reset_high_water() or 0  # on other systems than Linux both are unknown
    try:
        with warnings.catch_warnings(), _limited():
            warnings.simplefilter("ignore")
            function(path)
        kind, words = "accepted", ""
    except VggtjaxError as error:
        kind, words = _judged(error)
    except (Exception, HangError) as error:  # all else is what this looks for
        where = traceback.extract_tb(error.__traceback__)
        own = [frame for frame in where if "/vggtjax/" in frame.filename or "/converters/" in frame.filename]
        frame = (own or where)[-1]
        words = f"{type(error).__name__} at {Path(frame.filename).name}:{frame.lineno}: {str(error)[:200]!r}"
        kind = "found"
    return Outcome(kind, words, max(0, (process_bytes("VmHWM") or 0) - before))


def change(folder: Path, random: Random) -> None:
    """Make one to three changes in a folder: of a file's content, mostly, or of the names, links and kinds of files."""
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        paths = sorted(path for path in folder.rglob("*") if not path.is_symlink())
        files = [path for path in paths if path.is_file()]
        if not files:
            return
        # Every name is as likely as another: of a folder of pictures with one list, the list is drawn often.
        kinds = sorted({(path.parent, path.suffix) for path in files})
        kind = random.choice(kinds)
        path = random.choice([path for path in files if (path.parent, path.suffix) == kind])
        if random.random() < 0.9:
            path.write_bytes(mutated(path.read_bytes(), random))
        else:
            random.choice(_TREE)(path, random)


def _linked(path: Path, random: Random) -> None:
    path.unlink()
    path.symlink_to(random.choice(("/dev/zero", "/etc/passwd", "/", ".", path.name, "missing", "/proc/self/mem")))


def _renamed(path: Path, random: Random) -> None:
    names = [name for name in NAMES if "/" not in name and "\0" not in name]
    name = random.choice((*names, " ", "-x", "$(x)", "x" * 250)).encode("utf-8", "surrogateescape")[:240]
    with suppress(OSError):  # ".." is there
        os.rename(path, os.fsencode(path.parent) + b"/" + name + os.fsencode(path.suffix))  # noqa: PTH104 - bytes


def _copied(path: Path, random: Random) -> None:
    name = random.choice((path.name.upper(), f"0{path.name}", f"{path.stem}.png", f"{path.stem}.json", f".{path.name}"))
    if not (path.parent / name).exists():
        shutil.copy(path, path.parent / name)


_TREE: tuple[Callable[[Path, Random], object], ...] = (
    lambda path, _: path.unlink(),
    lambda path, _: path.write_bytes(b""),
    lambda path, _: (path.unlink(), path.mkdir()),
    lambda path, _: (path.unlink(), os.mkfifo(path)),
    *(_linked, _renamed, _copied),
)


def _judged(error: Exception) -> tuple[str, str]:
    words, raw = str(error), str(error.args[0]) if error.args else ""
    if not words or not words.isprintable() or len(words) >= MOST_LETTERS:
        return "found", f"{type(error).__name__} with a message of {len(words)} letters: {words[:300]!r}"
    if len(raw) > _MOST_RAW_LETTERS:
        return "found", f"{type(error).__name__} puts {len(raw)} letters into its message: {words[:300]!r}"
    return "refused", words


@contextmanager
def _limited() -> Iterator[None]:
    """Raise HangError after MOST_SECONDS, where Python code runs or waits for a file."""

    def stop(_number: int, _frame: Any) -> None:
        raise HangError(f"after {MOST_SECONDS} s")

    earlier = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, MOST_SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, earlier)
