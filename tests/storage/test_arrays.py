import io
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vggtjax.errors import ResultError
from vggtjax.storage import arrays as archive

ARRAYS = {
    "grid": np.arange(12, dtype=np.float32).reshape(3, 4),
    "flags": np.array([True, False]),
    "number": np.array(7),
    "words": np.array(["a", "grüße", ""]),
    "empty_text": np.array(""),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("archive") / "whole.npz"
    archive.write_arrays(path, ARRAYS)
    return path


def store(path, members):
    """Write a zip file of the given members, without compression."""
    with zipfile.ZipFile(path, "w") as file:
        for name, data in members.items():
            file.writestr(name, data)


def npy(array, **options):
    file = io.BytesIO()
    np.lib.format.write_array(file, array, **options)
    return file.getvalue()


def test_round_trip(whole):
    read = archive.read_arrays(whole)
    assert list(read) == list(ARRAYS)
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(read[name], array)
        assert (read[name].dtype, read[name].shape) == (array.dtype, array.shape)
    assert archive.read_headers(whole)["grid"] == (np.dtype(np.float32), (3, 4))


def test_numpy_reads_and_writes_the_same_format(whole, tmp_path):
    with np.load(whole, allow_pickle=False) as loaded:
        np.testing.assert_array_equal(loaded["grid"], ARRAYS["grid"])
    np.savez_compressed(tmp_path / "numpy.npz", grid=ARRAYS["grid"])
    np.testing.assert_array_equal(archive.read_arrays(tmp_path / "numpy.npz")["grid"], ARRAYS["grid"])


def test_python_objects_are_neither_written_nor_read(tmp_path):
    with pytest.raises(ValueError, match="Object arrays cannot be saved"):
        archive.write_arrays(tmp_path / "a.npz", {"trap": np.array([print], object)})
    store(tmp_path / "b.npz", {"trap.npy": npy(np.array([{}], object), allow_pickle=True)})
    for read in (archive.read_headers, archive.read_arrays):
        with pytest.raises(ResultError, match="Python objects, which are never loaded"):
            read(tmp_path / "b.npz")


def test_structured_arrays_with_objects_are_refused(tmp_path):
    store(tmp_path / "a.npz", {"trap.npy": npy(np.array([(1, {})], [("a", "i4"), ("b", "O")]), allow_pickle=True)})
    with pytest.raises(ResultError, match="Python objects"):
        archive.read_arrays(tmp_path / "a.npz")


def test_declared_sizes_are_checked_before_reading(tmp_path, monkeypatch):
    header = npy(np.zeros(4, np.float32)).replace(b"(4,), }    ", b"(10**9,), }"[:11])
    huge = npy(np.zeros(4, np.float32)).replace(b"'shape': (4,), }         ", b"'shape': (4000000000,), }")
    assert len(header) == len(huge)
    store(tmp_path / "a.npz", {"huge.npy": huge})
    with pytest.raises(ResultError, match=r"huge.npy is 16 bytes long; its header says 16000000000"):
        archive.read_arrays(tmp_path / "a.npz")
    monkeypatch.setattr(archive, "SIZE_LIMIT", 100)
    store(tmp_path / "b.npz", {"x.npy": npy(np.zeros(40))})
    with pytest.raises(ResultError, match="expected at most 100"):
        archive.read_headers(tmp_path / "b.npz")


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ({"notes.txt": b"hello"}, "expected arrays only"),
        ({"x.npy": b"hello"}, "not a whole .npz"),
        ({"x.npy": npy(np.zeros(3), version=(3, 0))}, "version"),
        ({"x.npy": npy(np.zeros((2, 3), order="F"))}, "by columns"),
        ({"x.npy": npy(np.zeros(3, ">f4"))}, "byte order"),
        ({"x.npy": npy(np.frombuffer(b"\xff" * 4, "<U1"))}, "not Unicode"),
        ({"x.npy": npy(np.zeros(3))[:-1]}, "bytes long"),
        ({"x.npy": npy(np.zeros(3)) + b"more"}, "bytes long"),
    ],
)
def test_members_that_are_not_arrays(tmp_path, members, message):
    store(tmp_path / "a.npz", members)
    with pytest.raises(ResultError, match=message):
        archive.read_arrays(tmp_path / "a.npz")


def test_two_members_of_one_name(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
        file.writestr("x.npy", npy(np.zeros(3)))
        with pytest.warns(UserWarning, match="Duplicate name"):
            file.writestr("x.npy", npy(np.ones(3)))
    with pytest.raises(ResultError, match="same name"):
        archive.read_arrays(tmp_path / "a.npz")


def test_compression_that_numpy_does_not_write(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_BZIP2) as file:
        file.writestr("x.npy", npy(np.zeros(3)))
    with pytest.raises(ResultError, match="compressed in a way"):
        archive.read_arrays(tmp_path / "a.npz")


def test_files_that_cannot_be_read(tmp_path):
    (tmp_path / "text.npz").write_text("not a zip")
    with pytest.raises(ResultError, match=r"not a whole \.npz"):
        archive.read_arrays(tmp_path / "text.npz")
    with pytest.raises(ResultError, match="cannot be read"):
        archive.read_arrays(tmp_path)


@given(cut=st.integers(0, 2000), position=st.integers(0, 5000), value=st.integers(0, 255))
def test_damaged_files_are_refused_or_read(whole, cut, position, value):
    data = bytearray(whole.read_bytes())
    data[position % len(data)] = value
    damaged = whole.with_name("damaged.npz")
    damaged.write_bytes(data[: len(data) - max(0, cut - 1000)])
    try:
        arrays = archive.read_arrays(damaged)
    except ResultError:
        return
    assert sum(array.nbytes for array in arrays.values()) < 10_000
