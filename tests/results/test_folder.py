"""Results that replace earlier ones, in processes that are killed at any moment."""

import errno
import shutil
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.results.test_export import files
from tests.room import make_room
from vggtjax.errors import OutputError
from vggtjax.results.archive import ARCHIVE_NAME, saved_files
from vggtjax.results.folder import NAMES, check_folder, find_archive, replacing
from vggtjax.results.reconstruction import Reconstruction


class Killed(BaseException):
    """The process is dead: nothing runs after this."""


@contextmanager
def killed_after(n):
    """Let the process die once n files or folders were renamed or removed: no later one is."""
    calls = iter(range(10_000))

    def dying(function):
        def call(*arguments, **options):
            if next(calls) >= n:
                raise Killed
            return function(*arguments, **options)

        return call

    with pytest.MonkeyPatch.context() as patch:
        for owner, name in ((Path, "rename"), (Path, "replace"), (Path, "unlink"), (shutil, "rmtree")):
            patch.setattr(owner, name, dying(getattr(owner, name)))
        yield


def save(folder, frames, optional):
    """Save a result whose files, but the archive, say only how many frames it has."""
    with replacing(folder, optional) as staged:
        for name in (*NAMES, *optional):
            (staged / name).write_text(str(frames))
        make_room(frames, 14, 14).save_archive(staged / ARCHIVE_NAME, files=optional)


def frames_of(folder):
    """Return the frames of the result in a folder, of which every file must be."""
    result = Reconstruction.load(folder)
    others = {ARCHIVE_NAME, ".vggtjax.lock"}  # a killed process leaves the file of its lock, which is free
    texts = {path.name: path.read_text() for path in folder.iterdir() if path.name not in others}
    assert set(texts) - set(saved_files(folder / ARCHIVE_NAME)) == set(NAMES)
    assert set(texts.values()) == {str(len(result.depth))}
    return len(result.depth)


@pytest.mark.parametrize("optional", [None, (), ("vggt4d",)])
def test_a_killed_replacement_is_finished_by_the_next(tmp_path, optional):
    (tmp_path / "old").mkdir()
    if optional is not None:
        save(tmp_path / "old", 1, optional)
    lengths, n, folder = set(), 0, tmp_path
    for n in range(60):
        folder = tmp_path / str(n)
        shutil.copytree(tmp_path / "old", folder)
        try:
            with killed_after(n):
                save(folder, 2, ("tracks.npz",))
            break
        except Killed:
            pass
        loaded = len(Reconstruction.load(folder).depth) if find_archive(folder).is_file() else None
        lengths.add(loaded)
        pending = (folder / ".replacing").exists()
        check_folder(folder)
        if loaded is not None:
            assert frames_of(folder) == (2 if pending else loaded), n
        save(folder, 3, ())
        assert frames_of(folder) == 3, n
    assert 12 < n < 59
    assert lengths == ({None, 2} if optional is None else {1, 2})
    assert frames_of(folder) == 2


@pytest.mark.parametrize("failing", range(0, 25, 3))
def test_a_failed_replacement_is_undone(tmp_path, monkeypatch, failing):
    make_room(2).save(tmp_path)
    before = files(tmp_path)
    rename, calls = Path.rename, []

    def fail_once(source, target):
        calls.append(target)
        if len(calls) == failing + 1:
            raise PermissionError(errno.EACCES, "Permission denied")
        return rename(source, target)

    monkeypatch.setattr(Path, "rename", fail_once)
    if failing < 23:
        with pytest.raises(OutputError, match="Permission denied"):
            make_room(3).save(tmp_path)
        assert files(tmp_path) == before
    else:
        make_room(3).save(tmp_path)
        assert len(Reconstruction.load(tmp_path).depth) == 3
