"""The user's cache: its folder, and the compiled programs that commands keep there."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from vggtjax.storage.cache import _show_warning, cache_folder, keep_compilations

PROGRAM = """
from vggtjax.storage.cache import keep_compilations
assert keep_compilations()
import jax, jax.numpy as jnp
jax.jit(lambda x: jnp.tanh(x @ x).sum())(jnp.ones((64, 64))).block_until_ready()
"""


def test_the_folder_can_be_named(monkeypatch, tmp_path):
    monkeypatch.setenv("VGGTJAX_CACHE", str(tmp_path / "here"))
    assert cache_folder() == tmp_path / "here"
    monkeypatch.delenv("VGGTJAX_CACHE")
    assert cache_folder().name == "vggtjax"


def compiled(environment, folder: Path) -> int:
    made = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    assert "Warning" not in made.stderr
    return len(list(folder.glob("*-cache"))) if folder.is_dir() else 0


def test_compiled_programs_are_kept_where_the_user_says(tmp_path):
    own = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    own |= {"VGGTJAX_CACHE": str(tmp_path), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    assert compiled(own, tmp_path / "compiled") > 0
    elsewhere = own | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "elsewhere"), "VGGTJAX_CACHE": str(tmp_path / "b")}
    assert compiled(elsewhere, tmp_path / "elsewhere") > 0
    assert not (tmp_path / "b").exists()


def test_damaged_entries_are_made_anew(tmp_path):
    own = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    own |= {"VGGTJAX_CACHE": str(tmp_path), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    compiled(own, tmp_path / "compiled")
    contents = {path: path.read_bytes() for path in (tmp_path / "compiled").glob("*-cache")}
    damaged = max(contents)
    damaged.write_bytes(contents[damaged][:100])
    half_written, unused = tmp_path / "compiled" / "jit_other-0-cache", tmp_path / "compiled" / "jit_used-0-cache"
    half_written.write_bytes(b"no time of use beside it")
    for path in (unused, unused.with_name("jit_used-0-atime")):
        path.write_bytes(bytes(8))
    compiled(own, tmp_path / "compiled")
    assert set((tmp_path / "compiled").glob("*-cache")) == {*contents, unused}
    assert len(damaged.read_bytes()) > 1000


@pytest.mark.parametrize("kind", ["reading", "writing"])
def test_a_cache_that_cannot_be_used_is_warned_about_once(tmp_path, monkeypatch, kind):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    shown, said = set(), []
    text = f"Error {kind} persistent compilation cache entry for 'jit_f': OSError: [Errno 28] No space left on device"
    kept = tmp_path / "jit_g-0-cache", tmp_path / "jit_g-0-atime"
    for path in kept:
        path.touch()
    for _ in range(3):
        _show_warning(said.append, shown, text)
    _show_warning(said.append, shown, "another warning")
    assert said == [text, "another warning"]
    assert all(path.exists() for path in kept)


@pytest.mark.skipif("jax" not in sys.modules, reason="nothing here has imported jax")
def test_nothing_changes_once_jax_is_imported(monkeypatch):
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    assert not keep_compilations()
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ
