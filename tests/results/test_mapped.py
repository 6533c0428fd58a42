"""Long results: arrays that stay files, opened lazily, written and read without being in memory as a whole."""

import dataclasses

import numpy as np
import pytest

from tests.room import make_room
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.storage import arrays as stored
from vggtjax.storage.arrays import is_mapped, spread_frames, zeros_beside

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
    there, here = (
        {path.relative_to(tmp_path / of) for path in (tmp_path / of).rglob("*") if path.is_file()}
        for of in ("memory", "mapped")
    )
    assert there == here
    for name in sorted(there - {name for name in there if name.suffix in (".npz", ".html")}):
        assert (tmp_path / "memory" / name).read_bytes() == (tmp_path / "mapped" / name).read_bytes(), name


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
