"""Kept texts: made once, made anew where a file is damaged, and dependent on every source of the package."""

from pathlib import Path

import jax
import pytest

import vggtjax
from vggtjax.storage import kept_text as module
from vggtjax.storage import versions
from vggtjax.storage.cache import compiled_folder
from vggtjax.storage.kept_text import kept_text


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Keep texts, as commands do, where they enable jax's cache of compiled programs."""
    monkeypatch.setenv("VGGTJAX_CACHE", str(tmp_path))
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(compiled_folder()))
    yield tmp_path / "texts"
    jax.config.update("jax_compilation_cache_dir", before)


@pytest.mark.parametrize("damage", [b"", b'{"a": [1,', b"\xff" * 99])
def test_text_is_kept_and_made_anew_where_it_is_damaged(folder, damage):
    assert kept_text("name", lambda: "one") == "one"
    (path,) = folder.iterdir()
    assert kept_text("name", lambda: "two") == "one"
    assert kept_text("other", lambda: "two") == "two"
    path.write_bytes(damage)
    assert kept_text("name", lambda: "three") == "three"
    assert kept_text("name", lambda: "four") == "three"


def test_the_oldest_go_first(folder, monkeypatch):
    monkeypatch.setattr(module, "MOST_TEXTS", 2)
    for name in "abc":
        kept_text(name, lambda: "text")
    assert len(list(folder.iterdir())) == 2
    assert kept_text("c", lambda: "other") == "text"


def test_without_a_cache_nothing_is_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("VGGTJAX_CACHE", str(tmp_path))
    assert kept_text("name", lambda: "one") == "one"
    assert kept_text("name", lambda: "two") == "two"
    assert not list(tmp_path.iterdir())


def test_kept_files_depend_on_every_file_of_the_package(tmp_path, monkeypatch):
    assert Path(vggtjax.__file__).parent == versions._PACKAGE
    monkeypatch.setattr(versions, "_PACKAGE", tmp_path)
    (tmp_path / "network").mkdir()
    digests = set()
    for name, text in (("a.py", "1"), ("network/b.py", "1"), ("network/b.py", "2"), ("notes.txt", "")):
        (tmp_path / name).write_text(text)
        digests.add(versions.source_digest.__wrapped__())
    assert len(digests) == 3
