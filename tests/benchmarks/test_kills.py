"""A conversion that is killed and run again, and a harness that finds what it looks for."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import kills as harness
from vggtjax.errors import InputError

ROOT = Path(__file__).parents[2]


_WRITES = """
import os, sys
from pathlib import Path
from benchmarks import killed_process
folder = Path(sys.argv[1])
killed_process.watch(folder, 3)
(folder.parent / "elsewhere").write_text("not counted")
(folder / "a").write_text("first")
(folder / "a").replace(folder / "b")
(folder / "c").write_text("third")
"""


def test_a_process_kills_itself_just_before_a_change_of_a_file(tmp_path):
    folder = tmp_path / "watched"
    folder.mkdir()
    done = subprocess.run([sys.executable, "-c", _WRITES, str(folder)], check=False, cwd=ROOT)
    assert done.returncode == -signal.SIGKILL
    assert list(harness.files_below(folder)) == ["b"]


def test_conversions_that_are_killed():
    """In a process of its own: a fork after jax has started threads is not safe."""
    words = ["-m", "benchmarks", "kills", "--command", "convert", "--kills", "4", "--pairs", "1"]
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "convert: 4 kills, 0 problems" in done.stdout


def test_an_unknown_command():
    with pytest.raises(InputError, match="command is 'view'; expected one of convert, "):
        harness.kills(command=("view",))
