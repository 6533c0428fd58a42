"""A conversion that is killed and run again, and a harness that finds what it looks for."""

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from safetensors.numpy import save_file

from benchmarks import kills as harness
from benchmarks.file_contents import BROKEN
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


_REMOVES = """
import shutil, sys
from pathlib import Path
from benchmarks import killed_process
folder = Path(sys.argv[1])
changes = killed_process.watch(folder, None)
shutil.rmtree(folder / "a")
assert next(changes) == 3
"""


def test_files_of_a_removed_folder_count(tmp_path):
    (tmp_path / "a").mkdir()
    for name in "xy":
        (tmp_path / "a" / name).touch()
    subprocess.run([sys.executable, "-c", _REMOVES, str(tmp_path)], check=True, cwd=ROOT)


def test_half_written_files_are_told_apart_and_times_are_not_compared(tmp_path):
    np.savez(tmp_path / "a.npz", x=np.ones(100))
    save_file({"x": np.ones(100, np.float32)}, tmp_path / "a.safetensors")
    Image.fromarray(np.eye(30, dtype=np.uint8)).save(tmp_path / "a.png")
    (tmp_path / "a.json").write_text('{"x": 1, "seconds": {"all": 2.5}}')
    (tmp_path / "a.html").write_text("<p>1.5 s</p></html>")
    (tmp_path / "a.csv").write_text("step,seconds\n1,0.5\n2,0.9\n")
    before = harness.files_below(tmp_path)
    assert BROKEN not in before.values()
    for name, old, new in (("a.json", "2.5", "99"), ("a.html", "1.5", "2.5"), ("a.csv", "0.9", "7")):
        (tmp_path / name).write_text((tmp_path / name).read_text().replace(old, new))
    assert harness.files_below(tmp_path) == before
    for path in tmp_path.iterdir():
        path.write_bytes(path.read_bytes()[:-5])
    assert set(harness.files_below(tmp_path).values()) == {BROKEN}


def test_what_a_killed_run_may_not_leave_is_noted(tmp_path):
    checks = harness._Checks(harness.CASES["export"], {"model": "", "model/a.txt": "1", "model/b.txt": "2"}, [])
    checks.check("absent", {".partial": ""}, ended=False)
    checks.check("whole", checks.whole, ended=False)
    assert checks.problems == []
    checks.check("half", {"model": "", "model/a.txt": "1", "model/c.txt": "3"}, ended=False)
    (tmp_path / "tmp/xyz").mkdir(parents=True)
    (tmp_path / "cache/compiled").mkdir(parents=True)
    for name in (".vggtjax-partial-0", "kept"):
        (tmp_path / "cache/compiled" / name).touch()
    for _ in range(2):  # each once
        checks.check_places("then run again", tmp_path)
    assert checks.problems == [
        "half: model/c.txt is left behind",
        "half: model/b.txt is missing",
        "then run again: tmp/xyz is left behind",
        "then run again: cache/compiled/.vggtjax-partial-0 is left behind",
    ]
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["kept"]


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
