import errno
from types import SimpleNamespace

import numpy as np
import pytest

from tests.results.test_export import expected_files
from tests.shared.contents import contents
from tests.shared.room import make_room
from vggtjax.errors import InputError, OutputError
from vggtjax.results import disk, export
from vggtjax.results.disk import forecast_bytes
from vggtjax.results.folder import replacing
from vggtjax.results.saving import Saving

pytestmark = pytest.mark.usefixtures("empty_reports")


@pytest.mark.parametrize("name", ["depth", "static.ply"])
def test_files_of_others_are_never_replaced(tmp_path, name):
    path = tmp_path / name
    if path.suffix:
        path.write_text("mine")
    else:
        path.mkdir()
        (path / "000000.png").write_text("mine")
    before, words = contents(tmp_path), rf"{name} exists and is not part of an earlier result.*choose another folder"
    with pytest.raises(OutputError, match=words):
        make_room(1).save(tmp_path)
    assert contents(tmp_path) == before
    np.savez(tmp_path / "reconstruction.npz", points=np.zeros(3))
    with pytest.raises(OutputError, match=r"exists and is not part"):
        make_room(1).save(tmp_path)


@pytest.mark.parametrize(("writer", "earlier"), [("encode_depth", False), ("result_scene", True), ("write_page", True)])
def test_full_disk_leaves_the_earlier_result_untouched(tmp_path, monkeypatch, writer, earlier):
    folder = tmp_path / "result"
    if earlier:
        make_room(2).save(folder)
    before = contents(tmp_path)

    def fail(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(export, writer, fail)
    with pytest.raises(OutputError, match="No space left on device; choose a folder"):
        make_room(3).save(folder)
    assert contents(tmp_path) == before
    assert {path.name for path in folder.iterdir()} == {name.split("/")[0] for name in contents(folder)}


def test_what_fails_leaves_nothing_behind(tmp_path):
    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_room(5).save(tmp_path, progress=stop)
    with pytest.raises(InputError, match="confidence_percentile is 100"):
        make_room(1).save(tmp_path, confidence_percentile=100)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OutputError, match=r"cannot write .*file is a file"):
            make_room(1).save(folder)


def test_what_is_no_longer_written_goes_away_as_a_whole(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    make_room(2).save(tmp_path, format="vggt4d")
    make_room(3).save(tmp_path, only=("depth", "cameras"))
    numbers = (f"depth/{frame:06d}.{kind}" for frame in range(3) for kind in ("npy", "png"))
    single = ("notes.txt", "reconstruction.npz", "trajectory.txt", "intrinsics.txt", "depth/scale.txt")
    assert set(contents(tmp_path)) == {*single, *numbers}
    (tmp_path / "mask").mkdir()  # of this name, but not part of the result
    make_room(2).save(tmp_path, only=("previews",))
    with pytest.raises(OutputError, match="mask exists and is not part of an earlier result"):
        make_room(2).save(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"reconstruction.npz", "preview", "mask", "notes.txt"}


def test_a_new_kind_of_file_is_not_lost(tmp_path):
    with pytest.raises(ValueError, match=r"\['notes.txt'\] would not be moved"), replacing(tmp_path, ()) as new:
        (new / "notes.txt").write_text("written by a new exporter")
    assert not contents(tmp_path)


def test_links_are_replaced_and_not_followed(tmp_path):
    make_room(1).save(tmp_path / "result")
    elsewhere = tmp_path / "elsewhere"
    (tmp_path / "result" / "frames").rename(elsewhere)
    try:
        (tmp_path / "result" / "frames").symlink_to(elsewhere, target_is_directory=True)
    except OSError:
        pytest.skip("this system does not let us make links")
    make_room(2).save(tmp_path / "result")
    assert set(contents(elsewhere)) == {"000000.ply"}
    assert set(contents(tmp_path / "result")) == expected_files(2)


SAVINGS = [Saving(resolution="original", format="vggt4d"), Saving(only=("clouds",))]


@pytest.mark.parametrize("saving", SAVINGS)
def test_the_forecast_is_right_within_a_factor_of_two(tmp_path, saving):
    random = np.random.default_rng(0)
    noise = random.integers(0, 60, (2, 112, 154, 3))
    plain = make_room(2, 112, 154)
    room = make_room(2, 112, 154, images=(plain.images // 2 + noise).astype(np.uint8))
    room.save(tmp_path, saving=saving)
    written = sum(path.stat().st_size for path in tmp_path.rglob("*") if path.is_file())
    assert 0.5 < forecast_bytes(room.depth.shape, room.source_size, saving) / written < 2


def test_too_little_space_is_said_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(disk.shutil, "disk_usage", lambda _: SimpleNamespace(free=1000))
    words = r"takes about [0-9.]+ kB and the disk of .* has 1.0 kB left; free some, .*--only"
    with pytest.raises(OutputError, match=words):
        make_room(1).save(tmp_path / "new")
    assert not (tmp_path / "new").exists()
