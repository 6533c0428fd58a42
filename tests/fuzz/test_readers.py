"""Every reader of strangers' files, on structural mutations of a valid sample, and on cases that were found earlier.

A found case becomes files in corpus/READER/CASE/, put over the sample: the long test writes them, and says where.
"""

import mmap
import os
import re
from pathlib import Path
from unittest.mock import Mock

import pytest

from tests.fuzz.cases import Reader, Sample, read, scratch_folder
from tests.fuzz.rows import foreign, own_files, weights
from tests.shared.dataset_files import write
from vggtjax.errors import ClipError, InputError, VggtjaxError

# Every place where a file or a folder of a stranger enters the library, used as the commands use it.
READERS = (*weights.ROWS, *own_files.ROWS, *foreign.ROWS)
CASES, MANY = 4, 2000
PATIENCE = 60.0  # seconds of a case; a busy machine is no fault of the reader
CORPUS = Path(__file__).parent / "corpus"
# Readers of our own kept results: what is damaged is made anew, without a word.
SILENT = {"evaluation"}


@pytest.fixture
def folder():
    with scratch_folder() as folder:
        yield folder


@pytest.fixture
def sample(reader, folder, caplog, monkeypatch) -> Sample:
    monkeypatch.setattr("tests.fuzz.cases.MOST_SECONDS", PATIENCE)
    caplog.set_level("CRITICAL")
    return Sample(reader, folder)


every_reader = pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)


@every_reader
def test_only_sentences_escape(sample):
    outcomes = {seed: sample.run(seed) for seed in range(CASES)}
    assert {seed: outcome.words for seed, outcome in outcomes.items() if outcome.kind == "found"} == {}


@pytest.mark.proof
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # Pillow leaves some files to be closed
@every_reader
def test_only_sentences_escape_from_thousands_of_changes(sample, reader, tmp_path):
    found, refused = {}, 0
    for seed in range(CASES, MANY):
        outcome = sample.run(seed)
        refused += outcome.kind == "refused"
        if outcome.kind == "found":
            sample.keep(seed, tmp_path / str(seed))
            found[str(tmp_path / str(seed))] = outcome.words
    assert found == {}
    assert (refused == 0) if reader.name in SILENT else (refused >= MANY // 10)


@pytest.mark.parametrize("case", sorted(CORPUS.glob("*/*")), ids=lambda case: f"{case.parent.name}-{case.name}")
def test_a_case_that_was_found_is_met_by_a_sentence_or_read(case, folder):
    (reader,) = [reader for reader in READERS if re.sub(r"\W+", "-", reader.name.lower()) == case.parent.name]
    outcome = Sample(reader, folder).run(case)
    assert outcome.kind != "found", outcome.words


def test_what_the_harness_looks_for_is_found(folder, monkeypatch):
    odd = type("Odd", (VggtjaxError,), {"__str__": lambda _: "two\nlines"})
    for error in (InputError("x" * 6000), ClipError(""), KeyError("x"), odd()):
        assert read(Mock(side_effect=error), folder).kind == "found"
    assert read(Mock(side_effect=InputError("a sentence")), folder).kind == "refused"
    taken: list[mmap.mmap] = []  # not of malloc, which may have kept freed memory of other tests

    def greedy(path: Path) -> None:
        if path.read_bytes() != b"valid":
            taken.append(mmap.mmap(-1, 2**27))
            taken[-1].write(bytes(2**27))

    (folder / "case").mkdir()
    (folder / "case/file").write_bytes(b"other")
    reader = Reader("greedy", lambda place: write(place / "file", b"valid"), greedy)
    assert "took" in Sample(reader, folder / "greedy").run(folder / "case").words
    monkeypatch.setattr("tests.fuzz.cases.MOST_SECONDS", 0.2)
    os.mkfifo(folder / "pipe")
    assert "HangError" in read(lambda path: (path / "pipe").read_bytes(), folder).words
