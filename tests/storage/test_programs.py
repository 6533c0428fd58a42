"""Kept programs: traced once, equal numbers afterwards, made anew if a file is damaged."""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vggtjax
from vggtjax.storage import programs, versions
from vggtjax.storage.programs import Program, keep_type, kept_text


@keep_type
class Pair(NamedTuple):
    one: jax.Array
    other: jax.Array | None = None


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Keep programs, as commands do."""
    monkeypatch.setenv("VGGTJAX_CACHE", str(tmp_path))
    monkeypatch.setattr(programs, "_keeping", lambda: True)
    return tmp_path / "lowered"


def counted():
    """Return a function that counts how often it is traced, three times over: as three processes have it."""
    traced = []

    def weighed(pair: Pair, extra, factor=1.0, *, power: int):
        traced.append(power)
        return Pair(factor * pair.one**power, extra), jnp.sum(pair.one)

    return [Program(weighed) for _ in range(3)], traced


X = jnp.arange(6.0).reshape(2, 3)


def test_a_second_process_does_not_trace(folder):
    (first, second, _), traced = counted()
    first(Pair(X), None, 3.0, power=2)
    again, _ = second(Pair(X), None, 3.0, power=2)
    assert traced == [2]
    assert isinstance(again, Pair)
    assert np.array_equal(again.one, 3 * X**2)
    assert again.other is None
    # Keywords, shapes, types and structure make another program.
    assert np.array_equal(second(Pair(X), None, 5.0, power=2)[0].one, 5 * X**2)
    assert traced == [2]
    for number, (x, extra, power) in enumerate(((X, None, 3), (X[:1], None, 2), (X.astype(int), None, 2), (X, X, 2))):
        second(Pair(x), extra, 3.0, power=power)
        assert len(traced) == 2 + number


def test_calls_use_compiled_programs(folder):
    (first, second, _), traced = counted()
    shape = jax.ShapeDtypeStruct((2, 3), jnp.float32)
    for program in (first, second):
        compiling, made = program.compile(Pair(shape), None, 3.0, power=2)
        assert compiling.result().memory_analysis() is not None
        assert made[0].one.shape == (2, 3)
        assert np.array_equal(program(Pair(X), None, 3.0, power=2)[0].one, 3 * X**2)
    assert traced == [2]


@pytest.mark.parametrize("place", [0, 50, -3])
def test_damaged_programs_are_made_anew(folder, place):
    (first, second, third), traced = counted()
    first(Pair(X), None, power=2)
    (path,) = folder.iterdir()
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)
    for program in (second, third):
        assert np.array_equal(program(Pair(X), None, power=2)[0].one, X**2)
        assert traced == [2, 2]


def test_programs_that_cannot_be_kept_run(folder):
    def called(x):
        return jax.pure_callback(lambda x: np.asarray(x) + 1, jax.ShapeDtypeStruct(x.shape, x.dtype), x)

    assert np.array_equal(Program(called)(X), X + 1)
    assert not folder.exists()
    (program, other, _), _ = counted()
    gradient = jax.grad(lambda x: program(Pair(x), None, power=2)[0].one.sum())(X)  # traced from outside
    assert np.array_equal(gradient, 2 * X)
    folder.parent.mkdir(exist_ok=True)
    folder.write_text("a file where the folder would be")
    assert np.array_equal(other(Pair(X), None, power=2)[0].one, X**2)


def test_without_a_cache_nothing_is_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("VGGTJAX_CACHE", str(tmp_path))
    (program, *_), traced = counted()
    program.compile(Pair(X), None, power=2)
    program(Pair(X), None, power=2)
    assert traced == [2]
    assert not list(tmp_path.iterdir())


def test_the_oldest_go_first(folder, monkeypatch):
    monkeypatch.setattr(programs, "KEPT_BYTES", 1)
    (program, *_), _ = counted()
    program(Pair(X), None, power=2)
    program(Pair(X), None, power=3)
    assert kept_text("name", lambda: "text") == "text"
    assert not list(folder.iterdir())


@pytest.mark.parametrize("damage", [b"", b'{"a": [1,', b"\xff" * 99])
def test_text_is_kept_and_made_anew_where_it_is_damaged(folder, damage):
    assert kept_text("name", lambda: "one") == "one"
    (path,) = folder.iterdir()
    assert kept_text("name", lambda: "two") == "one"
    assert kept_text("other", lambda: "two") == "two"
    path.write_bytes(damage)
    assert kept_text("name", lambda: "three") == "three"
    assert kept_text("name", lambda: "four") == "three"


def test_kept_files_depend_on_every_file_of_the_package(tmp_path, monkeypatch):
    assert Path(vggtjax.__file__).parent == versions._PACKAGE
    monkeypatch.setattr(versions, "_PACKAGE", tmp_path)
    (tmp_path / "network").mkdir()
    digests = set()
    for name, text in (("a.py", "1"), ("network/b.py", "1"), ("network/b.py", "2"), ("notes.txt", "")):
        (tmp_path / name).write_text(text)
        digests.add(programs.source_digest.__wrapped__())
    assert len(digests) == 3
