import errno
import os
import signal
import subprocess
import sys
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest

from vggtjax.errors import OutputError
from vggtjax.storage import writing as module
from vggtjax.storage.writing import _remove_leftovers, check_free, locked_folder, staging, write_errors, writing

WRITER = """
import sys, time
from pathlib import Path
from vggtjax.storage import writing
with getattr(writing, sys.argv[1])(Path(sys.argv[2]), *sys.argv[3:]) as path:
    if path is not None:
        path = path / "half" if path.is_dir() else path
        path.write_text("half")
    print("ready", flush=True)
    time.sleep(60)
"""


@contextmanager
def other_process(*arguments):
    """Run a writer that has begun and does not end; kill it at the end."""
    command = [sys.executable, "-c", WRITER, *map(str, arguments)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        try:
            yield process
        finally:
            process.send_signal(signal.SIGKILL)


def halves(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file() and path.read_text() == "half"]


def test_a_file_or_folder_appears_at_the_end(tmp_path):
    with writing(tmp_path / "new" / "a.txt") as temporary:
        temporary.write_text("whole")
        assert temporary.suffix == ".txt"
        assert not (tmp_path / "new" / "a.txt").exists()
    with writing(tmp_path / "new" / "b") as temporary:
        temporary.mkdir()
        (temporary / "c").write_text("whole")
    with pytest.raises(TypeError), writing(tmp_path / "new" / "d") as temporary:
        temporary.write_text(3)  # pyright: ignore[reportArgumentType]: it makes the file, then fails
    there = [path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")]
    assert sorted(there) == ["new", "new/a.txt", "new/b", "new/b/c"]
    with pytest.raises(OutputError, match=r"cannot write .*a\.txt/e"), writing(tmp_path / "new/a.txt/e"):
        pass


@pytest.mark.skipif(os.name != "posix", reason="permission bits")
def test_the_umask_decides_and_stays(tmp_path, monkeypatch):
    def write(number: int) -> None:
        with writing(tmp_path / str(number)) as temporary:
            temporary.write_text("x")

    previous = os.umask(0o027)
    try:
        with monkeypatch.context() as patch:
            patch.setattr(os, "umask", None)  # of the whole process: two threads that change it can lose it
            with ThreadPoolExecutor(4) as pool:
                list(pool.map(write, range(20)))
            with staging(tmp_path / "staged") as staged:
                assert staged.stat().st_mode & 0o777 == 0o750
    finally:
        assert os.umask(previous) == 0o027
    assert {path.stat().st_mode & 0o777 for path in tmp_path.iterdir() if path.is_file()} == {0o640}


@pytest.mark.parametrize("kind", ["writing", "staging"])
def test_what_a_killed_writer_left_is_removed_by_the_next(tmp_path, kind):
    with other_process(kind, tmp_path / "a" if kind == "writing" else tmp_path):
        with writing(tmp_path / "b") as temporary:
            temporary.write_text("whole")
        assert len(halves(tmp_path)) == 1  # its writer lives
    assert len(halves(tmp_path)) == 1
    (tmp_path / ".vggtjax-partial-0123456789abcdef.lock").touch()  # of a writer that was killed even earlier
    _remove_leftovers.cache_clear()  # as in the next process
    with writing(tmp_path / "b") as temporary:
        temporary.write_text("whole")
    assert [path.name for path in tmp_path.iterdir()] == ["b"]


def test_only_our_old_leftovers_without_a_lock_are_removed(tmp_path):
    ours = tmp_path / ".vggtjax-partial-0123456789abcdef"
    names = {".partial-abcd1234", ".clip.partial", f"{ours.name}0", ".vggtjax-partial-notes"}
    for path in (ours, *(tmp_path / name for name in names)):
        path.mkdir()
    for seconds, left in ((-15, {ours.name, *names}), (15, names)):  # beside a day
        day_ago = time.time() - 24 * 3600
        for path in tmp_path.iterdir():
            os.utime(path, (day_ago - seconds, day_ago - seconds))
        _remove_leftovers.cache_clear()
        with staging(tmp_path):
            pass
        assert {path.name for path in tmp_path.iterdir()} == left


def test_writers_and_threads_of_one_process_keep_apart(tmp_path):
    with staging(tmp_path) as one:
        _remove_leftovers.cache_clear()
        with staging(tmp_path) as other:
            assert one.is_dir()
            other.rmdir()  # a folder that is gone is no error
    locked = locked_folder(tmp_path, "a batch")
    with ThreadPoolExecutor(1) as pool:
        pool.submit(locked.__enter__).result()
    locked.__exit__(None, None, None)  # by another thread
    with locked_folder(tmp_path, "a batch"):
        pass


@pytest.mark.skipif(os.name != "posix", reason="flock")
def test_a_file_system_without_locks_is_written_without_one(tmp_path, monkeypatch):
    import fcntl

    def flock(file, operation):
        for lock in tmp_path.glob(".vggtjax*.lock"):  # another program removes it
            lock.unlink()
        raise OSError(errno.ENOLCK, "no locks available")

    monkeypatch.setattr(fcntl, "flock", flock)
    with warnings.catch_warnings(record=True) as warned:
        warnings.resetwarnings()
        for name in ("a", "b"):
            with locked_folder(tmp_path, "a batch"), writing(tmp_path / name) as path:
                path.write_text("whole")
    assert [str(warning.message)[:28] for warning in warned] == ["the file system has no locks"]
    assert {path.name for path in tmp_path.iterdir()} == {"a", "b"}


@pytest.mark.skipif(os.name != "posix", reason="named pipes")
def test_an_error_names_what_is_in_the_way(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to("nowhere")
    (tmp_path / "there").symlink_to("file")
    os.mkfifo(tmp_path / "pipe")
    there = {"file": "a file", "there": "a file", "link": "a link to nowhere, which does not", "pipe": "not a folder"}
    for name, kind in there.items():
        refused = pytest.raises(OutputError, match=f"{name}/new: .*/{name} is {kind}")
        with refused, staging(tmp_path / name / "new"):
            pass
    for error in (OSError(errno.ENOSPC, "No space left"), OSError("No space left")):  # with and without a number
        with pytest.raises(OutputError, match=f"cannot write {tmp_path}: No space left; "), write_errors(tmp_path):
            raise error


@pytest.mark.parametrize(("text", "says"), [('{"format": "clip"}', True), ('{"format": "mask"}', False), ("[", False)])
def test_a_file_says_its_format(tmp_path, text, says):
    (tmp_path / "a.json").write_text(text)
    assert module.says_format(tmp_path / "a.json", "clip") is says


def test_a_check_finds_files_that_may_not_be_replaced_and_leaves_nothing(tmp_path):
    new, full = tmp_path / "a/b", tmp_path / "full"
    check_free(new, ("x",), replaced=False, what="result")
    assert not list(tmp_path.iterdir())
    full.mkdir()
    for name in ("x", "y"):
        (full / name).write_text("theirs")
    with pytest.raises(OutputError) as raised:
        check_free(full, ("free", "x", "y"), replaced=False, what="result")
    assert str(raised.value).startswith(f"{full / 'x'} exists and is not part of an earlier result, so it is not")
    with pytest.raises(OutputError, match="File name too long"):
        check_free(tmp_path / ("n" * 300), ("x",), replaced=False, what="result")
    check_free(full, ("x",), replaced=True, what="result")
    check_free(full, ("z",), replaced=False, what="result")
    assert {path.name for path in full.iterdir()} == {"x", "y"}


def test_a_locked_folder_has_one_writer(tmp_path):
    folder = tmp_path / "out"
    sentence = f"another run is writing the batch into {folder}; wait for it or choose another folder"
    with other_process("locked_folder", folder, "the batch"):
        with pytest.raises(OutputError) as raised, locked_folder(folder, "the batch"):
            pass
        assert str(raised.value) == sentence
    with locked_folder(folder, "the batch"), locked_folder(tmp_path, "the batch"):  # a killed process holds no lock
        for _ in range(2):
            with pytest.raises(OutputError), locked_folder(folder, "the batch"):
                pass
    assert not list(folder.iterdir())
    with pytest.raises(OutputError, match="cannot write"), locked_folder("/dev/null/x", "the batch"):
        pass
