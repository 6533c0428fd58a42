"""Long results: arrays that stay files, opened lazily, written and read without being in memory as a whole."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.shared.contents import contents
from tests.shared.room import make_room
from vggtjax.results import result as results
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.storage import arrays as stored
from vggtjax.storage.arrays import is_mapped, spread_frames, zeros_beside

ROOT = Path(__file__).parents[2]
FRAMES = 6
LARGE = ("depth", "depth_confidence", "dynamic_mask", "images", "saliency")


def mapped(folder, result) -> Reconstruction:
    """Return the same result with its large arrays in files."""
    folder.mkdir()
    arrays = {}
    for name in LARGE:
        value = getattr(result, name)
        arrays[name] = np.lib.format.open_memmap(folder / f"{name}.npy", "w+", value.dtype, value.shape)
        arrays[name][:] = value
    return dataclasses.replace(result, **arrays)


@pytest.fixture
def room(monkeypatch):
    monkeypatch.setattr(stored, "_LEAST_MAPPED", 64)
    return make_room(FRAMES)


@pytest.mark.usefixtures("empty_reports")
def test_a_mapped_result_writes_the_files_of_one_in_memory_and_opens_lazily(room, tmp_path):
    room.save(tmp_path / "memory")
    found = mapped(tmp_path / "arrays", room)
    assert is_mapped(found.valid_pixels)
    assert np.array_equal(found.valid_pixels, room.valid_pixels)
    assert is_mapped(found.instances)
    found.save(tmp_path / "mapped")
    again = Reconstruction.load(tmp_path / "mapped")
    for name in LARGE:
        value = getattr(again, name)
        assert is_mapped(value), name
        assert value.flags.aligned
        assert np.array_equal(value, getattr(room, name))
    again.depth[0] = 7  # leaves the file
    assert np.array_equal(Reconstruction.load(tmp_path / "mapped").depth, room.depth)
    assert not is_mapped(Reconstruction.load(tmp_path / "memory").depth)
    there, here = contents(tmp_path / "memory"), contents(tmp_path / "mapped")
    assert there.keys() == here.keys()
    assert [name for name in there if there[name] != here[name] and not name.endswith((".npz", ".html"))] == []


def test_statistics_of_large_mapped_arrays_are_of_evenly_spread_frames(tmp_path, monkeypatch):
    values = np.lib.format.open_memmap(tmp_path / "a.npy", "w+", np.float32, (10, 4, 4))
    values[:] = np.arange(10)[:, None, None]
    assert spread_frames(values)[0] is values
    monkeypatch.setattr(stored, "_MOST_SPREAD", 64)
    few, same = spread_frames(values, np.asarray(values))
    assert few[:, 0, 0].tolist() == [0, 3, 6, 9]
    assert np.array_equal(few, same)
    whole = np.zeros((10, 4, 4), np.float32)
    assert spread_frames(whole)[0] is whole
    assert not is_mapped(zeros_beside(whole, bool))


@pytest.mark.proof
def test_two_thousand_frames_open_below_200_megabytes(tmp_path):
    """The arrays are sparse files of 0.7 GB, all depth 0: unknown."""
    frames, side = 2000, 160
    room = make_room(1, side - side % 14, side - side % 14)
    shape = (frames, *room.depth.shape[1:])
    fields = {}
    for name in results.ARRAYS:
        value = getattr(room, name)
        if name in LARGE:
            places = (frames, *value.shape[1:])
            fields[name] = np.lib.format.open_memmap(tmp_path / f"{name}.npy", "w+", value.dtype, places)
        elif value is not None:
            fields[name] = np.repeat(value, frames, axis=0)
    long = dataclasses.replace(room, **fields, frame_names=tuple(f"{number}" for number in range(frames)))
    path = tmp_path / "reconstruction.npz"
    long.save_archive(path)
    assert path.stat().st_size > 0.5e9
    code = (
        "import sys\n"
        "from vggtjax.storage.process_memory import process_bytes\n"
        "from vggtjax.results.reconstruction import Reconstruction\n"
        "result = Reconstruction.load(sys.argv[1])\n"
        "assert result.depth.shape == (2000, *map(int, sys.argv[2:]))\n"
        "assert result.depth[1000].max() == 0\n"
        "print(process_bytes('VmHWM'))\n"
    )
    words = [sys.executable, "-c", code, str(path), *map(str, shape[1:])]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) < 200e6
