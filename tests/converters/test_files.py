"""Readers of PyTorch weights: every layout gives the same parameters, and none is trusted."""

import json
import os
import pickle
import zipfile

import jax
import ml_dtypes
import numpy as np
import pytest
from safetensors.numpy import save_file

from converters import convert, convert_state_dict
from converters.files import choose_file, read_state_dict, weight_files
from tests.shared.make_checkpoint import make_checkpoint
from vggtjax import load_model
from vggtjax.errors import CheckpointError

INDEX = "model.safetensors.index.json"
SHARDS = [f"model-0000{number}-of-00003.safetensors" for number in (1, 2, 3)]
KEY = "camera_head.pose_branch.fc1.bias"


@pytest.fixture(scope="session")
def expected(seeded, config):
    return convert_state_dict(seeded, config)


@pytest.fixture(scope="module")
def tensors(torch, seeded):
    return {name: torch.from_numpy(value) for name, value in seeded.items()}


@pytest.fixture
def small():
    """A few tensors: enough for what does not look at names."""
    return {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.ones(5, np.float16)}


@pytest.fixture
def few(tmp_path):
    """Three tensors in three shards."""
    make_checkpoint(tmp_path / "few", {KEY: [4], "b": [4], "c": [4]}, shards=3)
    return tmp_path / "few"


def refusal(path, function=read_state_dict) -> str:
    with pytest.raises(CheckpointError) as raised:
        function(path)
    return str(raised.value)


def assert_converts(source, config, expected, tmp_path):
    made = load_model(convert(source, tmp_path / "converted.safetensors", config=config).path).params
    assert jax.tree.all(jax.tree.map(np.array_equal, made, expected))


def edit_index(folder, change):
    path = folder / INDEX
    index = json.loads(path.read_text())
    change(index)
    path.write_text(json.dumps(index))
    return path


# Layouts


@pytest.mark.parametrize(
    ("name", "format"), [("model.safetensors", "safetensors"), ("mislabelled.pt", "safetensors"), ("model.pth", "pt")]
)
def test_one_file(shapes, config, expected, tmp_path, name, format):
    make_checkpoint(tmp_path / name, shapes, format=format)
    assert_converts(tmp_path / name, config, expected, tmp_path)


@pytest.mark.parametrize("dtype", [ml_dtypes.bfloat16, np.float16])
def test_other_types(state_dict, config, tmp_path, dtype):
    cast = {name: value.astype(dtype) for name, value in state_dict.items()}
    save_file(cast, tmp_path / "model.safetensors")
    read = read_state_dict(tmp_path / "model.safetensors")
    assert all(read.tensors[name].dtype == dtype and np.array_equal(read.tensors[name], cast[name]) for name in cast)
    widened = {name: value.astype(np.float32) for name, value in cast.items()}
    assert_converts(tmp_path / "model.safetensors", config, convert_state_dict(widened, config), tmp_path)


def test_shards(shapes, config, expected, tmp_path):
    folder = tmp_path / "sharded"
    make_checkpoint(folder, shapes, shards=3)
    assert_converts(folder, config, expected, tmp_path)
    assert weight_files(folder / INDEX) == [folder / INDEX, *(folder / shard for shard in SHARDS)]


def test_old_training_checkpoint_is_read_into_memory(torch, tensors, config, expected, tmp_path, caplog):
    wrapped = {"state_dict": {"model": tensors, "optimizer": {"lr": 0.1}}, "epoch": 3}
    torch.save(wrapped, tmp_path / "old.pt", _use_new_zipfile_serialization=False)
    assert_converts(tmp_path / "old.pt", config, expected, tmp_path)
    assert "read into memory" in caplog.text


def test_torch_types_and_views(torch, tmp_path):
    x = torch.arange(12.0).reshape(3, 4)
    content = {"half": x.half(), "brain": x.bfloat16(), "view": x.T[1:], "parameter": torch.nn.Parameter(x)}
    torch.save(content, tmp_path / "types.pt")
    read = read_state_dict(tmp_path / "types.pt").tensors
    assert read["brain"].dtype == ml_dtypes.bfloat16
    for name, value in content.items():
        assert np.array_equal(np.asarray(read[name]).astype(np.float32), value.detach().float().numpy())


def test_tensors_are_mapped_not_read(torch, small, tmp_path):
    small |= {"scalar": np.array(3.0), "empty": np.zeros((0, 3), np.float32)}
    save_file(small, tmp_path / "model.safetensors")
    torch.save({name: torch.from_numpy(value) for name, value in small.items()}, tmp_path / "model.pt")
    for name in ("model.safetensors", "model.pt"):
        read = read_state_dict(tmp_path / name).tensors
        assert all(np.array_equal(read[key], small[key]) and read[key].shape == small[key].shape for key in small)
        assert not np.asarray(read["a"]).flags.owndata


# Finding


def test_choice_among_files():
    names = ["model.safetensors", INDEX, SHARDS[0], "model.pt"]  # the first choice first
    others = ["README.md", ".x.partial.safetensors", "sub/x.safetensors"]
    for first in range(4):
        assert choose_file(others + names[first:], "here") == names[first]
    with pytest.raises(CheckpointError, match="here holds no weights; expected one of"):
        choose_file(others, "here")
    with pytest.raises(CheckpointError, match=r"here holds 2 files of weights \(a.pt, b.pth\)"):
        choose_file(["a.pt", "b.pth"], "here")


# Damage and malice


def header(content: bytes) -> bytes:
    return len(content).to_bytes(8, "little") + content


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "is empty"),
        ((2**40).to_bytes(8, "little") + b"{}", "claims 1099511627776 bytes"),
        (header(b'{"a": {"dtype": "' + b"F" * 9000 + b'"}}'), "is not a whole safetensors file"),
        (header(b'{"a": {"dtype": "F32", "shape": [2], "data_offsets": [0, 99]}}'), "is not a whole safetensors file"),
        (header(b'{"a": {"dtype": "F4", "shape": [2], "data_offsets": [0, 1]}}') + b"\0", "has tensors of type F4"),
    ],
)
def test_not_weights(tmp_path, content, reason):
    path = tmp_path / "model.safetensors"
    path.write_bytes(content)
    assert reason in refusal(path)


@pytest.mark.parametrize("format", ["safetensors", "pt"])
def test_truncated_files(tmp_path, format):
    path = tmp_path / f"model.{format}"
    make_checkpoint(path, {KEY: [4]}, format=format)
    path.write_bytes(path.read_bytes()[:-10])
    assert "is not a whole" in refusal(path)


class Code:
    def __reduce__(self):
        return os.mkdir, ("ran",)


@pytest.mark.parametrize("archive", [True, False])
def test_pickled_code_never_runs(torch, tmp_path, monkeypatch, archive):
    monkeypatch.chdir(tmp_path)
    torch.save({"a": torch.ones(2), "b": Code()}, "evil.pt", _use_new_zipfile_serialization=archive)
    assert "could run code, and is not opened" in refusal(tmp_path / "evil.pt")
    (tmp_path / "plain.pt").write_bytes(pickle.dumps({"b": Code()}))
    assert "could run code, and is not opened" in refusal(tmp_path / "plain.pt")
    assert not (tmp_path / "ran").exists()


def test_compressed_archive(torch, tmp_path):
    torch.save({"a": torch.zeros(1000)}, tmp_path / "model.pt")
    source = zipfile.ZipFile(tmp_path / "model.pt")
    with source, zipfile.ZipFile(tmp_path / "bomb.pt", "w", zipfile.ZIP_DEFLATED) as target:
        for entry in source.infolist():
            target.writestr(entry.filename, source.read(entry))
    assert "is a compressed archive" in refusal(tmp_path / "bomb.pt")


def test_entries_that_are_not_tensors(torch, tensors, config, tmp_path):
    strange = {"number": 3, 5: torch.ones(1), "sparse": torch.eye(2).to_sparse(), "meta": torch.ones(1, device="meta")}
    torch.save(tensors | strange, tmp_path / "model.pt")
    message = refusal(tmp_path / "model.pt", lambda path: convert(path, tmp_path / "x.safetensors", config=config))
    assert "4 problems" in message
    for name in strange:
        assert f"entry {name!r} is not a dense tensor" in message


# Shards


@pytest.mark.parametrize("name", ["../x.safetensors", "/etc/passwd", "..", "", "a\\b", "c:x", "a\0", 3])
def test_index_stays_in_its_folder(few, name):
    (few.parent / "x.safetensors").write_bytes(b"outside")
    path = edit_index(few, lambda index: index["weight_map"].update({KEY: name}))
    assert "expected names of files in its folder" in refusal(path)


def test_index_and_shards_that_disagree(few, config, tmp_path):
    def change(index):
        index["weight_map"] |= {"ghost": SHARDS[0], KEY: SHARDS[1]}
        del index["weight_map"]["b"]

    index = edit_index(few, change)
    save_file({"b": np.ones(4), "c": np.ones(4)}, few / SHARDS[1])
    expected = {
        f"key {KEY} is in {SHARDS[0]}; the index says {SHARDS[1]}",
        f"key b is in {SHARDS[1]}; the index says nothing",
        f"duplicate key c in {SHARDS[1]} and {SHARDS[2]}",
        "key ghost of the index is in no shard",
    }
    assert set(read_state_dict(index).problems) == expected
    message = refusal(index, lambda path: convert(path, tmp_path / "x.safetensors", config=config))
    assert "key ghost of the index" in message
    for shard in SHARDS[:2]:
        (few / shard).unlink()
    assert f"2 problems: missing shard {SHARDS[0]}; missing shard {SHARDS[1]}" in refusal(index)
