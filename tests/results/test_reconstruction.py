import copy
import dataclasses
import io
import pickle
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from tests.shared.contents import contents
from tests.shared.room import make_room
from vggtjax.errors import InputError, ResultError
from vggtjax.results import result as results
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.results.result import FieldOfViewWarning
from vggtjax.storage import arrays as archive
from vggtjax.storage.arrays import is_mapped, spread_frames, zeros_beside


def assert_equal(first: Reconstruction, second: Reconstruction) -> None:
    for field in dataclasses.fields(Reconstruction):
        left, right = getattr(first, field.name), getattr(second, field.name)
        assert type(left) is type(right), field.name
        assert getattr(left, "dtype", None) == getattr(right, "dtype", None), field.name
        np.testing.assert_equal(left, right, err_msg=field.name)


@pytest.fixture
def stored(tmp_path):
    """Path of an archive, and a function that writes it again with some of its arrays replaced or (None) removed."""
    path = tmp_path / "reconstruction.npz"
    make_room(2).save_archive(path)

    def change(**changes):
        arrays = archive.read_arrays(path) | changes
        archive.write_arrays(path, {name: array for name, array in arrays.items() if array is not None})
        return path

    return change


@pytest.mark.parametrize("timestamps", [None, np.array([0, 0.1, 0.25])])
def test_archive_round_trip(tmp_path, timestamps):
    depth = make_room().depth.copy()
    depth[0, 0, :2] = (np.nan, np.inf)
    names = ("../a.png", "grüße 漢字", "")
    settings = {"cues": (1, 2), "nested": {"gram": None, "half": 0.5}}
    room = make_room(timestamps=timestamps, depth=depth, frame_names=names, settings=settings, passes=object())
    room.save_archive(tmp_path / "reconstruction.npz")
    loaded = Reconstruction.load(tmp_path)
    assert loaded.passes is None
    assert loaded.settings["cues"] == [1, 2]
    assert_equal(loaded, dataclasses.replace(room, passes=None))
    assert_equal(loaded, Reconstruction.load(tmp_path / "reconstruction.npz"))
    assert loaded.depth.flags.writeable
    assert repr(loaded).startswith("Reconstruction(3 frames of 42 x 28 pixels, method '4dvggt-d', model 'tiny', 10.2%")
    assert_equal(loaded, dataclasses.replace(loaded, valid_box=room.valid_box.astype(np.int32)))  # types are cast


def test_nothing_moves_in_padding():
    room = make_room(dynamic_mask=np.ones((3, 28, 42), bool), valid_box=np.tile([0, 7, 42, 21], (3, 1)))
    np.testing.assert_array_equal(room.dynamic_mask, room.inside_pictures)
    np.testing.assert_array_equal(room.instances > 0, room.inside_pictures)
    assert room.dynamic_share == 1


def test_fields_of_view_are_clamped_with_a_warning():
    intrinsics = make_room(14).intrinsics.copy()
    intrinsics[:12, 1, 1] = np.inf
    intrinsics[13, 0, 0] = -5
    words = r"frames 0, 1, .*, 9 and 3 more was clamped to \[0.01, 3.1\] rad"
    with pytest.warns(FieldOfViewWarning, match=words) as seen:
        room = make_room(14, intrinsics=intrinsics)
    assert len(seen) == 1
    np.testing.assert_allclose(room.intrinsics[0, 1, 1], 14 / np.tan(0.005), rtol=1e-6)
    np.testing.assert_allclose(room.intrinsics[13, 0, 0], 21 / np.tan(1.55), rtol=1e-6)
    assert np.isinf(intrinsics[0, 1, 1]), "the caller's array is not changed"
    assert_equal(room, dataclasses.replace(room))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"depth": np.ones((28, 42))}, r"depth has shape \(28, 42\); expected \(frames, rows, columns\)"),
        ({"valid_box": np.array([[0, 0, 42, 28]] * 2 + [[0, 0, 43, 28]])}, r"valid_box of frame 2 is \[0, 0, 43, 28\]"),
        ({"camera_from_world": np.tile(np.diag([1, 1, -1, 1.0])[:3], (3, 1, 1))}, "camera_from_world of frame 0"),
        ({"intrinsics": make_room().intrinsics / [[[1]], [[np.nan]], [[1]]]}, "field of view of frame 1"),
        (
            {"depth": np.where(np.arange(3)[:, None, None] == 1, np.nan, make_room().depth)},
            r"depth of frame 1 has no finite value, and 1176 of 3528 values .* are not finite; check the weights",
        ),
        ({"depth_confidence": np.full((3, 28, 42), np.inf)}, "depth_confidence of frame 0 has no finite value"),
        ({"settings": {"a": float("nan")}}, "settings cannot be written as JSON"),
    ],
)
def test_fields_that_do_not_fit(changes, message):
    with pytest.raises(ResultError, match=message):
        make_room(**changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"depth": None}, "missing or unknown: depth"),
        ({"format_version": np.array(99)}, "format version 99; expected 1"),
        ({"depth": np.zeros((2, 28, 42))}, "depth has type float64; expected float32"),
        ({"settings": np.array("[" * 100_000)}, "recursion"),
        ({"method": np.frombuffer(b"\xff" * 4, "<U1").reshape(())}, "text that is not Unicode"),
    ],
)
def test_archives_that_are_not_results(stored, changes, message):
    path = stored(**changes)
    with pytest.raises(ResultError, match=message) as error:
        Reconstruction.load(path)
    assert str(path) in str(error.value)


def test_all_arrays_can_be_written_and_are_not_the_callers():
    room = make_room()
    saliency = np.array(room.saliency)
    saliency.flags.writeable = False
    result = dataclasses.replace(room, saliency=saliency, dynamic_mask=jnp.asarray(room.dynamic_mask))
    for name in ("depth", "saliency", "dynamic_mask", "camera_from_world", "intrinsics", "images"):
        getattr(result, name)[0] = 0
    assert saliency[0].any() == np.asarray(room.saliency)[0].any()
    assert not np.asarray(result.saliency)[0].any()


def test_a_copy_is_equal_and_apart():
    room = make_room()
    for other in (copy.deepcopy(room), pickle.loads(pickle.dumps(room))):  # noqa: S301 - its own bytes
        for field in dataclasses.fields(room):
            np.testing.assert_equal(getattr(other, field.name), getattr(room, field.name))
        other.depth[0] = 0
        assert room.depth[0].any()


def test_what_is_no_path_and_no_result_is_named():
    for path in (None, b"out", io.BytesIO(), 3):
        with pytest.raises(ResultError, match=f"the path is a {type(path).__name__}; expected the folder of a result"):
            Reconstruction.load(path)  # type: ignore
    for other in ("demo-output", [make_room()]):
        with pytest.raises(InputError, match=f"a {type(other).__name__} is given to the viewer; expected results"):
            make_room().view(other)  # type: ignore


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
    monkeypatch.setattr(archive, "_LEAST_MAPPED", 64)
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
    monkeypatch.setattr(archive, "_MOST_SPREAD", 64)
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
        "from vggtjax.storage.memory import process_bytes\n"
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
