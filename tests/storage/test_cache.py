"""The user's cache: its folder, compiled programs and kept texts, made anew where a file is damaged."""

import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import jax
import pytest

import vggtjax
from vggtjax.storage import kept_text as module
from vggtjax.storage import versions
from vggtjax.storage.cache import _say_how_to_keep, _show_warning, compiled_folder, hint_compilation_cache
from vggtjax.storage.kept_text import kept_text

PROGRAM = """
import sys
if sys.argv[1:] == ["late"]:
    import jax
    jax.jit(lambda x: x + 1)(1.0)  # looks for a cache
import vggtjax
folder = vggtjax.enable_compilation_cache()
assert vggtjax.enable_compilation_cache() == folder
assert ("jax" in sys.modules) == (sys.argv[1:] == ["late"])
import jax, jax.numpy as jnp
assert jax.config.values["jax_compilation_cache_dir"] == str(folder)
is_own = folder.parent != __import__("vggtjax.storage.cache", fromlist=["_"]).cache_folder()
assert jax.config.values["jax_compilation_cache_max_size"] == (-1 if is_own else 2 * 2**30)
jax.jit(lambda x: jnp.tanh(x @ x).sum())(jnp.ones((64, 64))).block_until_ready()
"""


def compiled(environment, folder: Path, *arguments: str) -> int:
    command = [sys.executable, "-c", PROGRAM, *arguments]
    made = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    assert "Warning" not in made.stderr
    return len(list(folder.glob("*-cache"))) if folder.is_dir() else 0


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """The environment of a process that has compiled a program, and keeps it below VGGTJAX_CACHE."""
    own = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    own |= {"VGGTJAX_CACHE": str(tmp_path_factory.mktemp("cache")), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    assert compiled(own, Path(own["VGGTJAX_CACHE"]) / "compiled") > 0
    return own


def test_compiled_programs_are_kept_where_the_user_says(own, tmp_path):
    elsewhere = own | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "elsewhere"), "VGGTJAX_CACHE": str(tmp_path / "b")}
    assert compiled(elsewhere, tmp_path / "elsewhere", "late") > 0
    assert not (tmp_path / "b").exists()


def test_damaged_entries_are_made_anew(own):
    folder = Path(own["VGGTJAX_CACHE"]) / "compiled"
    contents = {path: path.read_bytes() for path in folder.glob("*-cache")}
    damaged = max(contents)
    damaged.write_bytes(contents[damaged][:100])
    half_written, unused = folder / "jit_other-0-cache", folder / "jit_used-0-cache"
    half_written.write_bytes(b"no time of use beside it")
    for path in (unused, unused.with_name("jit_used-0-atime")):
        path.write_bytes(bytes(8))
    compiled(own, folder)
    assert set(folder.glob("*-cache")) == {*contents, unused}
    assert len(damaged.read_bytes()) > 1000


def test_a_cache_that_cannot_be_used_is_warned_about_once(tmp_path):
    shown, said = set(), []
    text = "Error writing persistent compilation cache entry for 'jit_g': OSError: [Errno 28] No space left on device"
    kept = tmp_path / "jit_g-0-cache"
    kept.touch()
    kept.with_name("jit_g-0-atime").touch()
    for warning in (text, text, "another warning"):
        _show_warning(tmp_path, said.append, shown, warning)
    assert said == [text, "another warning"]
    assert kept.exists()


def test_a_script_is_told_once_how_to_keep_what_it_compiles(caplog, request):
    name = "jax_compilation_cache_dir"
    request.addfinalizer(partial(jax.config.update, name, jax.config.values[name]))
    jax.config.update(name, None)
    _say_how_to_keep.cache_clear()  # another test may have been told
    for seconds in (1.0, 30.0, 30.0):
        hint_compilation_cache(seconds)
    assert [record.message.count("enable_compilation_cache()") for record in caplog.records] == [1]


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
