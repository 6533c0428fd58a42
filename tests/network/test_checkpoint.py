"""Files of this library, and what `load_model` makes of names, paths and PyTorch weights."""

import dataclasses
import hashlib
import json
import logging
import sys
from functools import partial
from pathlib import Path

import jax
import ml_dtypes
import numpy as np
import pytest
from flax.traverse_util import flatten_dict
from safetensors import safe_open
from safetensors.numpy import save_file

import converters.torch_to_flax
from converters import convert_state_dict
from tests.shared.make_checkpoint import make_checkpoint
from tests.shared.seeded import seeded_images, seeded_state_dict
from vggtjax import load_model
from vggtjax.errors import CheckpointError, InputError, OutputError
from vggtjax.network.checkpoint import Model, is_checkpoint, read_model, save_model
from vggtjax.network.kernels.narrow import is_multiplied, narrowed
from vggtjax.network.kernels.quantised import as_multiplied
from vggtjax.network.model import forward


@pytest.fixture(scope="module")
def shapes(golden):
    return json.loads((golden / "shapes.json").read_text())


@pytest.fixture(scope="module")
def tree(shapes, config):
    """Parameters as numpy arrays."""
    return convert_state_dict(seeded_state_dict(shapes), config)


@pytest.fixture(scope="module")
def saved_once(tree, config, tmp_path_factory):
    return save_model(tmp_path_factory.mktemp("saved") / "tiny.safetensors", tree, config, name="tiny model")


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("VGGTJAX_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def rewritten(saved, path, metadata=None, **changes):
    """Copy a checkpoint with other metadata; the values of `changes` replace tensors, None removes them."""
    with safe_open(saved, framework="numpy") as file:
        tensors = file.get_tensors() | changes
        save_file({k: v for k, v in tensors.items() if v is not None}, path, file.metadata() | (metadata or {}))
    return path


def refusal(path, **options) -> str:
    with pytest.raises(CheckpointError) as raised:
        load_model(path, **options)
    assert "\n" not in str(raised.value)
    return str(raised.value)


# Files of this library


def test_round_trip(saved_once, tree, config, tmp_path):
    model = load_model(saved_once)
    assert model.config == config
    assert (model.name, model.path, model.note, model.dtype) == ("tiny model", saved_once, "", "float32")
    assert jax.tree.all(jax.tree.map(np.array_equal, model.params, tree))
    assert is_checkpoint(saved_once)
    assert load_model(saved_once.parent).path == saved_once
    copy = save_model(tmp_path / "copy.safetensors", model.params, model.config, name=model.name)
    assert copy.read_bytes() == saved_once.read_bytes()
    assert (model.summary()["parameters"], model.summary()["bytes"]) == (1_806_508, 4 * 1_806_508)


def test_bfloat16_and_mixed_round_trip(tree, config, tmp_path):
    half = jax.tree.map(lambda leaf: leaf.astype(ml_dtypes.bfloat16), tree)
    half["camera_head"] = tree["camera_head"]
    model = load_model(save_model(tmp_path / "half.safetensors", half, config))
    same = jax.tree.map(lambda a, b: a.dtype == b.dtype and np.array_equal(a, b), model.params, half)
    assert jax.tree.all(same)
    assert (model.name, model.dtype) == ("half", "bfloat16")


def test_note_and_untrained_heads_are_in_the_file(tree, config, tmp_path):
    path = save_model(tmp_path / "a.safetensors", tree, config, note="first attempt", untrained_heads=("tracks",))
    path = path.rename(tmp_path / "b.safetensors")
    model = load_model(path)
    assert model.warning == "The model a is a first attempt."
    assert model.untrained_heads == ("tracks",)
    assert model.summary()["heads"][-1] == "tracks (untrained)"
    for labels in ({"note": "two\nlines"}, {"untrained_heads": ("nose",)}):
        with pytest.raises(CheckpointError, match=r"'two\\nlines'|'nose'"):
            save_model(path, tree, config, **labels)


def test_type_on_loading(saved_once, tree):
    model = load_model(saved_once, dtype="bfloat16")
    same = jax.tree.map(lambda a, b: np.array_equal(a, b.astype(ml_dtypes.bfloat16)), model.params, tree)
    assert jax.tree.all(same)


def test_weights_in_the_type_of_the_products_give_equal_results(saved_once, config):
    images = seeded_images(2, 28, 42).transpose(0, 2, 3, 1)[None]
    stored, narrow = load_model(saved_once), load_model(saved_once, compute_dtype="bfloat16")
    flat: dict[str, jax.Array] = flatten_dict(stored.params, sep=".")  # type: ignore[assignment]
    products = sum(leaf.nbytes for name, leaf in flat.items() if is_multiplied(name))
    assert products > 0.3 * stored.parameter_bytes
    assert narrow.parameter_bytes == stored.parameter_bytes - products // 2
    assert narrow.identity == stored.identity
    assert load_model("demo", compute_dtype="bfloat16").identity == load_model("demo").identity
    expected = narrowed(stored.params, "bfloat16")
    assert jax.tree.all(jax.tree.map(np.array_equal, expected, as_multiplied(narrow.params)))
    if jax.default_backend() == "cpu":
        text = str(
            jax.jit(partial(forward, config=config, compute_dtype="bfloat16"))
            .lower(narrow.params, images)
            .compile()
            .as_text()
        )
        kernel = flat["backbone.blocks.mlp.fc1.kernel"].shape
        assert f"u16[{','.join(map(str, kernel))}]" in text
        assert f"f32[{','.join(map(str, kernel))}]" not in text  # XLA turns stacks of bfloat16 into float32, whole
    run = jax.jit(partial(forward, config=config, compute_dtype="bfloat16"))
    made = [run(model.params, images) for model in (stored, narrow)]
    assert jax.tree.all(jax.tree.map(np.array_equal, *made))
    with pytest.raises(InputError, match="compute_dtype is 'bf16'"):
        load_model(saved_once, compute_dtype="bf16")


@pytest.mark.skipif(
    jax.default_backend() != "cpu" or sys.platform != "linux", reason="a CPU reads from the map, Linux lists it"
)
def test_parameters_stay_in_the_file(saved_once):
    model = load_model(saved_once)
    addresses = [leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves(model.params)]
    lines = Path("/proc/self/maps").read_text().splitlines()
    maps = [line.split()[0].split("-") for line in lines if line.endswith(str(saved_once))]
    spans = [(int(begin, 16), int(end, 16)) for begin, end in maps]
    mapped = sum(any(begin <= address < end for begin, end in spans) for address in addresses)
    assert mapped > 0.9 * len(addresses)


def test_donation_does_not_write_into_the_file(saved_once):
    before = saved_once.read_bytes()
    model = load_model(saved_once)
    step = jax.jit(lambda params: jax.tree.map(lambda leaf: leaf + 1, params), donate_argnums=0)
    jax.block_until_ready(step(model.params))
    assert saved_once.read_bytes() == before


def test_identity(saved_once, config, tmp_path, monkeypatch):
    path = tmp_path / "copy.safetensors"
    path.write_bytes(saved_once.read_bytes())
    model, again = read_model(path), read_model(path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    assert model.identity.to_json() == {"name": "tiny model", "sha256": digest}
    with monkeypatch.context() as patch:
        patch.setattr(hashlib, "file_digest", None)  # one process hashes a file once
        assert again.identity == model.identity
    in_memory = Model(config, jax.tree.map(np.array, model.params), "tiny model")
    same = Model(config, model.params, "tiny model")
    assert in_memory.identity == same.identity != model.identity
    in_memory.params["camera_head"]["empty_pose"][:] += 1
    retrained = dataclasses.replace(model, params=in_memory.params)
    half, renamed = read_model(path, dtype="bfloat16"), read_model(path, name="other")
    other = Model(dataclasses.replace(config, num_heads=1), model.params, "tiny model")
    assert len({m.identity for m in (model, same, retrained, half, renamed, other)}) == 6


def test_identity_of_a_file_that_was_replaced(saved_once, tmp_path):
    path = tmp_path / "copy.safetensors"
    path.write_bytes(saved_once.read_bytes())
    model = read_model(path)
    rewritten(saved_once, tmp_path / "new", {"name": "new"})
    (tmp_path / "new").replace(path)
    assert model.identity == dataclasses.replace(model).identity
    assert model.identity.sha256 != hashlib.sha256(path.read_bytes()).hexdigest()


def test_save_is_strict(tree, config, tmp_path):
    wrong = {"camera_head": tree["camera_head"], "extra": np.zeros(2, np.float64)}
    missing = sum(not name.startswith("camera_head") for name in flatten_dict(tree, sep="."))
    with pytest.raises(CheckpointError, match=f"{missing + 2} problems: missing parameter"):
        save_model(tmp_path / "x.safetensors", wrong, config)
    with pytest.raises(CheckpointError, match="mis-shaped parameter depth_head"):
        save_model(tmp_path / "x.safetensors", tree, dataclasses.replace(config, dpt_features=8))
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        save_model(tmp_path / "file" / "x.safetensors", tree, config)


def test_file_is_checked_against_its_configuration(saved_once, tmp_path):
    path = rewritten(
        saved_once,
        tmp_path / "x.safetensors",
        **{
            "camera_head.trunk_norm.bias": None,
            "extra": np.zeros(3, np.float32),
            "camera_head.empty_pose": np.zeros((1, 2, 9), np.float32),
            "backbone.norm.scale": np.zeros(32, np.int64),
        },
    )
    message = refusal(path)
    assert "4 problems" in message
    for part in (
        "missing parameter camera_head.trunk_norm.bias",
        "unknown parameter extra",
        "mis-shaped parameter camera_head.empty_pose: [1, 2, 9], expected [1, 1, 9]",
        "parameter backbone.norm.scale has type int64",
    ):
        assert part in message


@pytest.mark.parametrize(
    ("metadata", "reason"),
    [
        ({"version": "2"}, "has version '2' of the format; this vggtjax reads '1'"),
        ({"config": '{"embed_dim": 1000000, "num_heads": 10, "dino_num_heads": 10}'}, "mis-shaped parameter"),
        ({"config": " " * 70_000}, "more than 65536 bytes"),
        ({"origin": '{"a": "b"}'}, "Expected `str` matching regex"),
        ({"origin": '{"\\u001b": "' + "0" * 64 + '"}'}, "unprintable letters"),
    ],
)
def test_metadata_is_not_trusted(saved_once, tmp_path, metadata, reason):
    assert reason in refusal(rewritten(saved_once, tmp_path / "x.safetensors", metadata))


# The demo


def test_demo_model(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    model = load_model("demo")
    assert (model.name, model.dtype, model.origin) == ("demo", "float32", {})
    assert load_model("demo", dtype="bfloat16").dtype == "bfloat16"
    assert "another configuration" in refusal("demo", config=dataclasses.replace(model.config, camera_num_heads=1))


# PyTorch weights


def test_torch_weights_are_converted_once(shapes, tree, config, tmp_path, cache, caplog, monkeypatch):
    caplog.set_level(logging.INFO)
    source = tmp_path / "weights.safetensors"
    make_checkpoint(source, shapes)
    calls = []
    model = load_model(source, config=config, progress=lambda *call: calls.append(call))
    assert jax.tree.all(jax.tree.map(np.array_equal, model.params, tree))
    assert model.name == "weights"
    assert [model.path] == list(cache.iterdir())
    assert f"converted {source} to {model.path}" in caplog.text
    assert calls[-1] == (1502 + 8, 1502 + 8)  # tensors, and blocks of the source

    with monkeypatch.context() as patch:
        patch.setattr(converters.torch_to_flax, "convert_weights", None)
        assert load_model(source, config=config).path == model.path

    assert model.path is not None
    whole = model.path.read_bytes()
    model.path.unlink()
    model.path.write_bytes(whole[:-100])  # damaged
    load_model(source, config=config)
    assert model.path.read_bytes() == whole

    make_checkpoint(source, shapes, seed=1)  # another file of that name
    changed = load_model(source, config=config)
    assert changed.path != model.path
    assert not np.array_equal(changed.params["camera_head"]["empty_pose"], model.params["camera_head"]["empty_pose"])


def test_conversions_differ_by_what_makes_them(shapes, config, tmp_path, cache):
    source = tmp_path / "weights.safetensors"
    make_checkpoint(source, shapes)
    narrow = dataclasses.replace(config, dpt_features=8)
    assert "does not fit the configuration" in refusal(source, config=narrow)
    assert not cache.exists()
    other = dataclasses.replace(config, dino_num_heads=1)
    models = [load_model(source, config=config, dtype="bfloat16"), load_model(source, config=other)]
    assert len({model.path for model in models}) == 2 == len(list(cache.iterdir()))
    assert [model.dtype for model in models] == ["bfloat16", "float32"]
    assert [model.config for model in models] == [config, other]


def test_folder_of_shards(shapes, config, tmp_path, cache):
    folder = tmp_path / "sharded"
    make_checkpoint(folder, shapes, shards=2)
    model = load_model(folder, config=config)
    assert model.name == "sharded"
    make_checkpoint(folder, shapes, shards=2, seed=1)
    assert load_model(folder, config=config).path != model.path
    next(folder.glob("*-00002-of-*")).unlink()
    assert "No such file or directory; copy or download" in refusal(folder, config=config)
