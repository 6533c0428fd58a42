import io
import zipfile

import numpy as np
import pytest

from vggtjax.errors import ResultError
from vggtjax.storage import arrays

ARRAYS = {
    "grid": np.arange(12, dtype=np.float32).reshape(3, 4),
    "flags": np.array([True, False]),
    "number": np.array(7),
    "words": np.array(["a", "grüße", ""]),
    "empty_text": np.array(""),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("arrays") / "whole.npz"
    arrays.write_arrays(path, ARRAYS)
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
    read = arrays.read_arrays(whole)
    assert list(read) == list(ARRAYS)
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(read[name], array)
        assert (read[name].dtype, read[name].shape) == (array.dtype, array.shape)
    assert arrays.read_headers(whole)["grid"] == (np.dtype(np.float32), (3, 4))


def test_numpy_reads_and_writes_the_same_format(whole, tmp_path):
    with np.load(whole, allow_pickle=False) as loaded:
        np.testing.assert_array_equal(loaded["grid"], ARRAYS["grid"])
    np.savez_compressed(tmp_path / "numpy.npz", grid=ARRAYS["grid"])
    np.testing.assert_array_equal(arrays.read_arrays(tmp_path / "numpy.npz")["grid"], ARRAYS["grid"])


def test_python_objects_are_neither_written_nor_read(tmp_path):
    with pytest.raises(ValueError, match="Object arrays cannot be saved"):
        arrays.write_arrays(tmp_path / "a.npz", {"trap": np.array([print], object)})
    for trap in (np.array([{}], object), np.array([(1, {})], [("a", "i4"), ("b", "O")])):
        store(tmp_path / "b.npz", {"trap.npy": npy(trap, allow_pickle=True)})
        for read in (arrays.read_headers, arrays.read_arrays):
            with pytest.raises(ResultError, match="Python objects or structures, which are never loaded"):
                read(tmp_path / "b.npz")


def test_declared_sizes_are_checked_before_reading(tmp_path, monkeypatch):
    huge = npy(np.zeros(4, np.float32)).replace(b"'shape': (4,), }         ", b"'shape': (4000000000,), }")
    store(tmp_path / "a.npz", {"huge.npy": huge})
    with pytest.raises(ResultError, match=r"huge.npy has 16 bytes of values; its header says 16000000000"):
        arrays.read_arrays(tmp_path / "a.npz")
    monkeypatch.setattr(arrays, "SIZE_LIMIT", 100)
    store(tmp_path / "b.npz", {"x.npy": npy(np.zeros(40))})
    with pytest.raises(ResultError, match="expected at most 100"):
        arrays.read_headers(tmp_path / "b.npz")


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ({"notes.txt": b"hello"}, "expected arrays alone"),
        ({"x.npy": npy(np.zeros((2, 3), order="F"))}, "column order"),
        ({"x.npy": npy(np.frombuffer(b"\xff" * 4, "<U1"))}, "not Unicode"),
        ({"x.npy": npy(np.zeros(3))[:-1]}, "bytes of values"),
    ],
)
def test_members_that_are_not_arrays(tmp_path, members, message):
    store(tmp_path / "a.npz", members)
    with pytest.raises(ResultError, match=message):
        arrays.read_arrays(tmp_path / "a.npz")


def test_archives_that_numpy_does_not_write(tmp_path):
    with zipfile.ZipFile(tmp_path / "twice.npz", "w") as file:
        file.writestr("x.npy", npy(np.zeros(3)))
        with pytest.warns(UserWarning, match="Duplicate name"):
            file.writestr("x.npy", npy(np.ones(3)))
    with zipfile.ZipFile(tmp_path / "bzip2.npz", "w", zipfile.ZIP_BZIP2) as file:
        file.writestr("x.npy", npy(np.zeros(3)))
    (tmp_path / "text.npz").write_text("not a zip")
    for name, message in (
        ("twice.npz", "same name"),
        ("bzip2.npz", "compression type 12"),
        ("text.npz", r"not a whole \.npz"),
        ("", "cannot be read"),
    ):
        with pytest.raises(ResultError, match=message):
            arrays.read_arrays(tmp_path / name)


def header(descr="'<f4'", shape="(4,)"):
    return f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}}}"


@pytest.mark.parametrize(
    "text",
    [
        header(shape="(-2, -2)"),
        header(shape="(" * 500 + ")" * 500),
        header(shape="(" + "9" * 5000 + ",)"),
        header(shape="(0, 10000000000000000000000)"),
        header("'<M8[xs]'", "(2,)"),
        header("'|S0'", "(60000000000,)"),
        " " * 20_000,
    ],
    ids=range(7),
)
def test_malformed_headers(tmp_path, text):
    content = text.encode("latin1")
    content = b"\x93NUMPY\x02\x00" + len(content).to_bytes(4, "little") + content + bytes(16)
    store(tmp_path / "a.npz", {"x.npy": content})
    (tmp_path / "x.npy").write_bytes(content)
    for read, name in ((arrays.read_headers, "a.npz"), (arrays.read_arrays, "a.npz"), (arrays.read_array, "x.npy")):
        with pytest.raises(ResultError, match=r"^x\.npy "):
            read(tmp_path / name)


def test_a_small_archive_of_large_arrays_is_refused(tmp_path, monkeypatch):
    large = np.zeros((300, 2**20), np.uint8)
    np.savez_compressed(tmp_path / "bomb.npz", depth=large)
    assert (tmp_path / "bomb.npz").stat().st_size < 2**20
    for read in (arrays.read_headers, arrays.read_arrays):
        with pytest.raises(ResultError, match=r"says that its arrays take 314572928; expected at most 16 times"):
            read(tmp_path / "bomb.npz")
    np.savez(tmp_path / "honest.npz", depth=large)
    assert arrays.read_headers(tmp_path / "honest.npz")["depth"].shape == large.shape


def test_archives_are_held_against_the_memory_that_is_free(whole, monkeypatch):
    monkeypatch.setattr(arrays, "_SPARE", 10)
    monkeypatch.setattr(arrays, "free_bytes", lambda: 20)
    with pytest.raises(ResultError, match=r"take \d+ bytes of memory and 20 are free"):
        arrays.read_arrays(whole)
    assert arrays.read_arrays(whole, ["missing"]) == {}  # what is not read takes nothing
    assert "grid" in arrays.read_headers(whole)


def test_a_stored_array_cannot_say_that_it_is_longer(tmp_path):
    store(tmp_path / "a.npz", {"x.npy": npy(np.zeros(100))})
    content = (tmp_path / "a.npz").read_bytes()
    size = (100 * 8 + 128).to_bytes(4, "little")
    at = content.rindex(size)  # in the zip's directory: the uncompressed size stands last
    (tmp_path / "a.npz").write_bytes(content[:at] + (2**31).to_bytes(4, "little") + content[at + 4 :])
    with pytest.raises(ResultError, match="made to fill the memory"):
        arrays.read_headers(tmp_path / "a.npz")
