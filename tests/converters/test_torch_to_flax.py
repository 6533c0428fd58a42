"""The conversion of PyTorch weights: the rule table, its strictness, and the file that it streams to."""

import dataclasses
import errno
import hashlib
import json
import math
import tracemalloc
from typing import Any

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest
from flax.traverse_util import flatten_dict
from safetensors import safe_open
from safetensors.numpy import save_file

from converters import convert, convert_state_dict
from converters.rules import CONV, DENSE, DEPTH_TO_SPACE, IGNORED, POINTWISE, SAME, TRACKS, UNBATCHED, rules
from converters.torch_to_flax import source_shapes
from vggtjax import forward, load_model
from vggtjax.config import vggt_1b
from vggtjax.errors import CheckpointError, InputError, OutputError
from vggtjax.network.checkpoint import flat_shapes
from vggtjax.network.model import HEADS

VIRTUAL_TRACKS = "track_head.tracker.updateformer.virual_tracks"
BIAS = "camera_head.pose_branch.fc1.bias"
ignored = IGNORED["vggt"].fullmatch


@pytest.fixture
def source(state_dict, tmp_path):
    save_file(state_dict, tmp_path / "tiny.safetensors", metadata={"format": "pt"})
    return tmp_path / "tiny.safetensors"


def test_rules_name_every_tensor_of_the_published_layout(golden, config):
    for model, file in ((config, "shapes.json"), (vggt_1b(), "shapes_vggt_1b.json")):
        published = {name: tuple(shape) for name, shape in json.loads((golden / file).read_text()).items()}
        assert source_shapes(model) == {name: shape for name, shape in published.items() if not ignored(name)}


def test_rules_fill_every_parameter_once(config):
    assert {rule.path for rule in rules(config)} == set(flat_shapes(config))
    assert len({rule.source for rule in rules(config)}) == len(rules(config))


@pytest.mark.parametrize(
    ("transform", "shape", "index", "target_index"),
    [
        (SAME, (2, 3), (1, 2), (1, 2)),
        (DENSE, (2, 3), (1, 2), (2, 1)),
        (CONV, (2, 3, 4, 5), (1, 2, 3, 4), (3, 4, 2, 1)),
        (POINTWISE, (2, 3, 1, 1), (1, 2, 0, 0), (2, 1)),
        (DEPTH_TO_SPACE, (2, 3, 4, 5), (1, 2, 3, 4), (1, 3, 4, 2)),
        (UNBATCHED, (1, 2, 3), (0, 1, 2), (1, 2)),
        (TRACKS, (1, 5, 1, 3), (0, 4, 0, 2), (4, 2)),
    ],
)
def test_transforms(transform, shape, index, target_index):
    x = np.arange(math.prod(shape)).reshape(shape)
    made = transform(x)
    assert made[target_index] == x[index]
    assert np.shares_memory(made, x)
    assert transform.source_shape(made.shape) == shape


def test_both_spellings_of_virtual_tracks(state_dict, config):
    published = convert_state_dict(state_dict, config)
    state_dict[VIRTUAL_TRACKS.replace("virual", "virtual")] = state_dict.pop(VIRTUAL_TRACKS)
    assert jax.tree.all(jax.tree.map(np.array_equal, convert_state_dict(state_dict, config), published))


def test_values_that_are_not_finite_are_refused_by_name(state_dict, config):
    key = next(key for key in state_dict if key.endswith("norm1.weight"))
    changed = state_dict[key].copy()
    changed[3] = np.inf
    with pytest.raises(CheckpointError, match=rf"1 of {changed.size} values of {key} are not finite"):
        convert_state_dict({**state_dict, key: changed}, config)


def test_a_checkpoint_of_another_width_names_the_option(state_dict, config):
    wider = dataclasses.replace(config, embed_dim=2 * config.embed_dim)
    with pytest.raises(CheckpointError, match=r"embed_dim is 32 in it and 64 in the .*: give its own by --config FILE"):
        convert_state_dict(state_dict, wider)


def test_all_problems_at_once(state_dict, config):
    beyond = "aggregator.frame_blocks.24.norm1.weight"
    both = VIRTUAL_TRACKS.replace("virual", "virtual")
    del state_dict[BIAS]
    state_dict |= {beyond: np.ones(32, np.float32), both: state_dict[VIRTUAL_TRACKS]}
    state_dict["aggregator.camera_token"] = np.ones((2, 1, 32), np.int32)
    with pytest.raises(CheckpointError, match="5 problems") as raised:
        convert_state_dict(state_dict, config)
    for part in (
        f"missing key {BIAS}",
        f"unknown key {beyond}",
        f"duplicate keys {VIRTUAL_TRACKS} and {both}",
        "mis-shaped key aggregator.camera_token: [2, 1, 32], expected [1, 2, 1, 32]",
        "key aggregator.camera_token has type int32",
    ):
        assert part in str(raised.value)


def test_convert_streams_the_same_arrays(state_dict, source, config, tmp_path):
    calls = []
    done = convert(source, tmp_path / "out" / "ours.safetensors", config=config, progress=lambda *c: calls.append(c))
    out, digest = done.path, hashlib.sha256(source.read_bytes()).hexdigest()
    expected: dict[str, Any] = flatten_dict(convert_state_dict(state_dict, config), sep=".")
    with safe_open(out, framework="numpy") as file:
        known = {"format": "vggtjax", "version": "1", "config": config.to_json(), "name": "tiny"}
        assert file.metadata() == known | {"origin": json.dumps({"tiny.safetensors": digest})}
        made = file.get_tensors()
    assert set(made) == set(expected)
    assert all(made[name].dtype == np.float32 and np.array_equal(made[name], expected[name]) for name in made)
    steps = done.tensors + -(-source.stat().st_size // 2**20)
    assert calls == [(step, steps) for step in range(1, steps + 1)]
    assert done.left_out == tuple(filter(ignored, state_dict))
    assert done.tensors == len(state_dict) - len(done.left_out)
    assert done.parameters == sum(array.size for array in expected.values())
    assert (done.bytes, done.dtype, done.sha256) == (out.stat().st_size, "float32", {"tiny.safetensors": digest})
    assert [path.name for path in out.parent.iterdir()] == ["ours.safetensors"]


@pytest.mark.parametrize("heads", [("depth", "camera"), ("points", "tracks")])
def test_convert_some_heads(state_dict, source, config, tmp_path, heads):
    done = convert(source, tmp_path / "part.safetensors", config=config, heads=heads)
    whole = convert_state_dict(state_dict, config)
    modules = {"backbone", "aggregator", *(HEADS[name] for name in heads)}
    made = load_model(done.path).params
    assert set(made) == modules
    assert jax.tree.all(jax.tree.map(np.array_equal, made, {name: whole[name] for name in modules}))
    assert done.tensors + len(done.left_out) == len(state_dict)


def test_some_heads_of_a_source_that_has_no_others(state_dict, config, tmp_path):
    camera = {name: value for name, value in state_dict.items() if not name.startswith(("depth", "point_", "track"))}
    save_file(camera, tmp_path / "camera.safetensors")
    model = load_model(convert(tmp_path / "camera.safetensors", tmp_path / "x", config=config, heads=["camera"]).path)
    assert model.heads == ("camera",)
    with pytest.raises(InputError, match=r"outputs has \['depth'\]; this model has only the heads \('camera',\)"):
        forward(model.params, jnp.zeros((1, 2, 56, 56, 3)), model.config)
    with pytest.raises(CheckpointError, match="it has no depth_head, point_head, track_head: omit these heads"):
        convert(tmp_path / "camera.safetensors", tmp_path / "y", config=config)
    with pytest.raises(InputError, match=r"heads has \['depht'\]; expected some of \('camera'"):
        convert(tmp_path / "camera.safetensors", tmp_path / "y", config=config, heads=["depht"])
    with pytest.raises(CheckpointError, match=r"unknown key depth_head\.extra"):  # strict about what is left out, too
        convert_state_dict(camera | {"depth_head.extra": np.ones(3)}, dataclasses.replace(config, heads=("camera",)))


def test_convert_rounds_to_bfloat16(state_dict, source, config, tmp_path):
    model = load_model(convert(source, tmp_path / "half.safetensors", config=config, dtype="bfloat16").path)
    expected = convert_state_dict(state_dict, config)
    same = jax.tree.map(lambda a, b: np.array_equal(a, b.astype(ml_dtypes.bfloat16)), model.params, expected)
    assert jax.tree.all(same)
    assert model.dtype == "bfloat16"


def test_large_arrays_are_aligned_for_memory_maps(source, config, tmp_path):
    content = convert(source, tmp_path / "ours.safetensors", config=config).path.read_bytes()
    length = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + length])
    spans = [entry["data_offsets"] for name, entry in header.items() if name != "__metadata__"]
    assert (8 + length) % 64 == 0
    assert all(begin % 64 == 0 for begin, end in spans if (end - begin) % 64 == 0)


def test_convert_holds_one_tensor_at_a_time(config, tmp_path):
    wide = dataclasses.replace(config, embed_dim=96)
    source = tmp_path / "wide.safetensors"
    save_file({name: np.zeros(shape, np.float32) for name, shape in source_shapes(wide).items()}, source)
    tracemalloc.start()
    try:
        out = convert(source, tmp_path / "ours.safetensors", config=wide).path
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 0.15 * out.stat().st_size


@pytest.mark.parametrize("name", ["ours.safetensors", "new.safetensors"])
def test_interrupted_conversion_leaves_what_was_there(source, config, tmp_path, name):
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "ours.safetensors").write_text("before")

    def fail(done, total):
        if done == 700:
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OutputError):
        convert(source, folder / name, config=config, progress=fail)
    assert [(path.name, path.read_text()) for path in folder.iterdir()] == [("ours.safetensors", "before")]


def test_convert_checks_its_arguments(source, config, tmp_path):
    with pytest.raises(InputError, match=r"tiny\.safetensors is the source; choose another name"):
        convert(source, source, config=config)
    with pytest.raises(InputError, match="dtype is 'float16'; expected one of"):
        convert(source, tmp_path / "x.safetensors", config=config, dtype="float16")  # pyright: ignore[reportArgumentType]
    with pytest.raises(CheckpointError, match="does not fit the configuration"):
        convert(source, tmp_path / "x.safetensors")
    assert not (tmp_path / "x.safetensors").exists()
