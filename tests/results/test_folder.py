import errno
import shutil
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.shared.contents import contents
from tests.shared.room import make_room
from vggtjax.errors import OutputError
from vggtjax.results import folder as folders
from vggtjax.results.archive import ARCHIVE_NAME, saved_names
from vggtjax.results.folder import check_folder, find_archive, replacing
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.results.saving import NAMES, OPTIONAL_FILES
from vggtjax.storage.writing import _remove_leftovers

pytestmark = pytest.mark.usefixtures("empty_reports")


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
        try:
            yield
        finally:
            _remove_leftovers.cache_clear()  # as in the next process


def save(folder, frames, names=NAMES):
    """Save a result whose files, but the archive, say only how many frames it has."""
    with replacing(folder, names) as staged:
        for name in names:
            (staged / name).write_text(str(frames))
        make_room(frames, 14, 14).save_archive(staged / ARCHIVE_NAME, files=names)


def frames_of(folder):
    """Return the frames of the result in a folder, of which every file must be."""
    result = Reconstruction.load(folder)
    others = {ARCHIVE_NAME, ".vggtjax.lock"}  # a killed process leaves the file of its lock, which is free
    texts = {path.name: path.read_text() for path in folder.iterdir() if path.name not in others}
    assert {ARCHIVE_NAME, *texts} == set(saved_names(folder / ARCHIVE_NAME))
    assert set(texts.values()) <= {str(len(result.depth))}
    return len(result.depth)


ALL = (*NAMES, *OPTIONAL_FILES)
FEW = ("scene.glb", "vggt4d")


@pytest.mark.parametrize(("old", "new"), [(None, NAMES), (ALL, FEW)])
def test_a_killed_replacement_is_finished_by_the_next(tmp_path, old, new):
    (tmp_path / "old").mkdir()
    if old is not None:
        save(tmp_path / "old", 1, old)
    lengths, n, folder = set(), 0, tmp_path
    for n in range(60):
        folder = tmp_path / str(n)
        shutil.copytree(tmp_path / "old", folder)
        try:
            with killed_after(n):
                save(folder, 2, new)
            break
        except Killed:
            pass
        loaded = len(Reconstruction.load(folder).depth) if find_archive(folder).is_file() else None
        lengths.add(loaded)
        pending = (folder / ".replacing").exists()
        check_folder(folder)
        if loaded is not None:
            assert frames_of(folder) == (2 if pending else loaded), n
        save(folder, 3)
        assert frames_of(folder) == 3, n
    assert len(new) < n < 59
    assert lengths == ({None, 2} if old is None else {1, 2})
    assert frames_of(folder) == 2


@pytest.mark.parametrize("failing", [13, 28])
def test_a_failed_replacement_is_undone(tmp_path, monkeypatch, failing):
    make_room(2).save(tmp_path)
    before = contents(tmp_path)
    rename, calls = Path.rename, []

    def fail_once(source, target):
        calls.append(target)
        if len(calls) == failing + 1:
            raise PermissionError(errno.EACCES, "Permission denied")
        return rename(source, target)

    monkeypatch.setattr(Path, "rename", fail_once)
    if failing < 26:
        with pytest.raises(OutputError, match="Permission denied"):
            make_room(3).save(tmp_path)
        assert contents(tmp_path) == before
    else:
        make_room(3).save(tmp_path)
        assert len(Reconstruction.load(tmp_path).depth) == 3


def test_a_run_waits_for_one_that_saves(tmp_path, monkeypatch):
    save(tmp_path, 1)
    monkeypatch.setattr(folders, "_WAIT", 0.1)
    rename, refused = Path.rename, []

    def attempted(source, target):
        if source.name == target.name == "depth" and not refused:
            for attempt in (lambda: check_folder(tmp_path), lambda: save(tmp_path, 4)):
                with pytest.raises(OutputError, match="another run is writing a result"):
                    attempt()
                refused.append(attempt)
        return rename(source, target)

    monkeypatch.setattr(Path, "rename", attempted)
    save(tmp_path, 3)
    assert len(refused) == 2
    assert frames_of(tmp_path) == 3
    assert not list(tmp_path.glob(".*"))
