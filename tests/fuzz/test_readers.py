"""Every reader of strangers' files, on fifty structural mutations of a valid sample, and on the cases found earlier.

`python -m benchmarks fuzz` runs thousands. A found case becomes files in corpus/READER/CASE/, put over the sample.
"""

import os
import re
from pathlib import Path

import pytest

from tests.fuzz.cases import Reader, Sample, read, scratch_folder
from tests.fuzz.readers import READERS
from vggtjax.errors import ClipError, InputError, VggtjaxError

CASES = 50
PATIENCE = 60.0  # seconds of a case; a busy machine is no fault of the reader
CORPUS = Path(__file__).parent / "corpus"
# Readers of our own caches and kept results: what is damaged is made anew, without a word.
SILENT = {"record", "kept passes", "cached program", "cut of windows", "state of a fit", "evaluation"}


@pytest.fixture
def folder():
    with scratch_folder() as folder:
        yield folder


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_only_sentences_escape(reader, folder, caplog, monkeypatch):
    monkeypatch.setattr("tests.fuzz.cases.MOST_SECONDS", PATIENCE)
    caplog.set_level("CRITICAL")
    sample = Sample(reader, folder)
    outcomes = {seed: sample.run(seed) for seed in range(CASES)}
    assert {seed: outcome.words for seed, outcome in outcomes.items() if outcome.kind == "found"} == {}
    refused = sum(outcome.kind == "refused" for outcome in outcomes.values())
    assert (refused == 0) if reader.name in SILENT else (refused >= CASES // 10)


def _corpus() -> list[tuple[str, Path]]:
    return [(folder.name, case) for folder in sorted(CORPUS.iterdir()) for case in sorted(folder.iterdir())]


@pytest.mark.parametrize(("name", "case"), _corpus(), ids=lambda part: part if isinstance(part, str) else part.name)
def test_a_case_that_was_found_is_met_by_a_sentence_or_read(name, case, folder):
    (reader,) = [reader for reader in READERS if slug(reader.name) == name]
    outcome = Sample(reader, folder).run(case)
    assert outcome.kind != "found", outcome.words


def slug(name: str) -> str:
    return re.sub(r"\W+", "-", name).strip("-").lower()


def test_what_the_harness_looks_for_is_found(folder, monkeypatch):
    monkeypatch.setattr("tests.fuzz.cases.MOST_SECONDS", 0.2)
    taken = []

    def long_sentence(_: Path) -> None:
        raise InputError("x" * 6000)

    def empty_sentence(_: Path) -> None:
        raise ClipError("")

    def waits(path: Path) -> None:
        os.mkfifo(path / "pipe")
        (path / "pipe").read_bytes()

    def raw(_: Path) -> None:
        raise KeyError("x")

    for function in (long_sentence, empty_sentence, waits, raw):
        assert read(function, folder).kind == "found"
    assert read(lambda path: taken.append(bytearray(2**26)), folder).bytes > 2**25

    class _UnprintableError(VggtjaxError):
        def __str__(self) -> str:
            return "two\nlines"

    def unprintable(_: Path) -> None:
        raise _UnprintableError("two\nlines")

    assert read(unprintable, folder).kind == "found"

    def make(folder: Path) -> Path:
        (folder / "file").write_bytes(b"valid")
        return folder / "file"

    def greedy(path: Path) -> None:
        if path.read_bytes() != b"valid":
            taken.append(bytearray(2**27))

    case = folder / "case"
    case.mkdir()
    (case / "file").write_bytes(b"other")
    assert "took" in Sample(Reader("greedy", make, greedy), folder / "greedy").run(case).words
