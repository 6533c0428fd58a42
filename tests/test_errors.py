"""Messages of errors: one printable line of a bounded length, whatever a stranger's file put into them."""

import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vggtjax import errors
from vggtjax.errors import MOST_LETTERS, ClipError, InputError, OutputError


@given(st.text(max_size=2000))
def test_every_message_is_one_printable_line(text):
    for kind in (InputError, ClipError, OutputError):
        shown = str(kind(text))
        assert shown.isprintable()
        assert len(shown) <= MOST_LETTERS
        assert shown == text or not text.isprintable() or len(text) > MOST_LETTERS


def test_the_middle_of_a_long_message_is_left_out():
    shown = str(InputError(f"{'x' * 2000} is bad; rename it"))
    assert shown.startswith("xxx")
    assert shown.endswith("x is bad; rename it")
    assert str(InputError("two\nlines \x1b[31m\udcff")) == "two lines ?[31m?"
    assert str(errors.MissingExtraError("depth", "exr")) == (
        "depth needs the extra 'exr'; in the folder of the vggtjax clone: pip install -e '.[exr]'"
    )


def test_problems_fill_a_message_and_no_more():
    problems = [f"missing key {number:04d}" for number in range(1000)]
    sentence = errors.problems_sentence("weights", problems)
    shown = sentence.count("missing key")
    assert sentence.startswith("weights: 1000 problems: missing key 0000; ")
    assert sentence.endswith(f"; and {1000 - shown} more")
    assert shown > 15
    assert len(sentence) <= MOST_LETTERS
    assert errors.problems_sentence("weights", ["y" * 5000, "z"]).endswith("y...; z")


def test_pipes_and_devices_are_refused_before_they_are_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zeros").symlink_to("/dev/zero")
    for name in ("pipe", "zeros"):
        with (
            pytest.raises(ClipError, match="is a pipe, a socket or a device"),
            errors.reading(tmp_path / name, ClipError),
        ):
            pytest.fail("it was opened")
    for fine in (tmp_path, tmp_path / "missing", "some words", "\0"):
        errors.check_regular(fine)
