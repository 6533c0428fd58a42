"""Checkpoints as trainers write them, and those of VGGT's relatives, which are refused by name."""

import argparse
import json
import logging
import types

import jax
import numpy as np
import pytest
from safetensors.numpy import save_file

from converters import convert, convert_state_dict
from converters.files import read_state_dict
from converters.foreign import FOREIGN, refuse_foreign
from converters.locate import locate
from vggtjax import load_model
from vggtjax.errors import CheckpointError

TINY = {"aggregator.camera_token": np.ones((1, 2), np.float32), "depth_head.norm.bias": np.zeros(3, np.float32)}


@pytest.mark.parametrize("prefix", ["module.", "model.", "_orig_mod.", "module._orig_mod.", "vggt.net."])
def test_a_shared_prefix_is_left_out_and_said(state_dict, config, caplog, prefix):
    plain = convert_state_dict(state_dict, config)
    assert not caplog.messages
    others = {"n_averaged": np.array(3)} if prefix == "module." else {}  # of torch's AveragedModel
    made = convert_state_dict(others | {prefix + name: value for name, value in state_dict.items()}, config)
    assert jax.tree.all(jax.tree.map(np.array_equal, made, plain))
    assert caplog.messages == [f"the keys of the state dict begin with {prefix}, which is left out"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda name: {f"base_model.{name}": 0, f"base_model.{name[:-7]}.lora_A.default.weight": 0}, "adapter"),
        (lambda name: {name: 0, name.replace(".weight", ".lora_down.weight"): 0}, "merge the adapter first"),
        (lambda name: {f"model.{name}": 0, f"ema_model.{name}": 0}, "twice or more, under 'ema_model.' and 'model.'"),
        (lambda name: {name: 0, f"ema.{name}": 0}, "twice or more, under no prefix and 'ema.'"),
        (lambda name: {f"module.{name}": 0, "module.aggregator.spatial_mask_head.x": 0}, "checkpoint of PAGE-4D"),
    ],
)
def test_keys_that_need_work_first(config, change, message):
    names = ("aggregator.frame_blocks.0.attn.qkv.weight", "camera_head.pose_branch.fc1.weight")
    keys = {key: np.zeros(1, np.float32) for name in names for key in change(name)}
    with pytest.raises(CheckpointError, match=message):
        convert_state_dict(keys, config)


@pytest.mark.parametrize(
    ("wrap", "said"),
    [
        (lambda own, tensor: own, None),
        (lambda own, tensor: {"model": own, "optimizer": {"state": {0: {"exp_avg": tensor}}}, "epoch": 3}, None),
        (lambda own, tensor: {"state_dict": own, "scale": tensor}, None),
        (lambda own, tensor: {"model": own, "ema": {"module": own}}, "are read from 'model'; those in ema"),
        (lambda own, tensor: {"ema": own, "steps": 7}, "weights are read from 'ema'"),
        (lambda own, tensor: {"module": own, "lr_scheduler": {"last": 1}}, "weights are read from 'module'"),
        (lambda own, tensor: {"ema": {"state_dict": own}}, "weights are read from 'ema'"),
    ],
)
def test_the_entry_that_is_read(torch, tmp_path, caplog, wrap, said):
    weights = {name: torch.from_numpy(value) for name, value in TINY.items()}
    torch.save(wrap(weights, torch.ones(2)), tmp_path / "a.pt")
    read = read_state_dict(tmp_path / "a.pt")
    assert read.problems == []
    assert set(read.tensors) == set(TINY)
    assert [said in message for message in caplog.messages] == [True] * (said is not None)


def test_several_entries_with_weights_are_refused(torch, tmp_path):
    weights = {name: torch.from_numpy(value) for name, value in TINY.items()}
    torch.save({"student": weights, "teacher": weights, "epoch": 1}, tmp_path / "a.pt")
    with pytest.raises(CheckpointError, match="holds weights in student, teacher; save one of them alone"):
        read_state_dict(tmp_path / "a.pt")


@pytest.mark.parametrize("value", [argparse.Namespace(lr=1), types.SimpleNamespace(lr=1), np.float64(2)])
def test_the_class_that_is_refused_is_named(torch, tmp_path, value):
    torch.save({"model": {"a": torch.ones(2)}, "args": value}, tmp_path / "a.pt")
    name = {argparse.Namespace: "argparse.Namespace", types.SimpleNamespace: "types.SimpleNamespace"}
    with pytest.raises(CheckpointError, match=name.get(type(value), r"numpy\.\S*multiarray\.scalar")):
        read_state_dict(tmp_path / "a.pt")


def test_weights_of_some_heads_make_a_model_of_these(state_dict, config, tmp_path, monkeypatch, caplog):
    """VGGT's trainer writes the heads that it trained: camera and depth."""
    monkeypatch.setenv("VGGTJAX_CACHE", str(tmp_path / "cache"))
    kept = {name: value for name, value in state_dict.items() if not name.startswith(("point_head", "track_head"))}
    save_file(kept, tmp_path / "trained.safetensors")
    with caplog.at_level(logging.WARNING):
        model = load_model(tmp_path / "trained.safetensors", config=config)
    assert model.heads == ("camera", "depth")
    assert "trained has the heads camera, depth, and not points, tracks" in caplog.messages
    assert load_model(tmp_path / "trained.safetensors", config=config).heads == ("camera", "depth")  # from the cache


# Keys as the networks' public code builds them.
KEYS = {
    "PAGE-4D": "aggregator.spatial_mask_head.head0.0.weight",
    "VGGT-Omega": "aggregator.inter_frame_blocks.0.norm1.weight",
    "OmniVGGT": "aggregator.camera_adapters.0.weight",
    "Pi3": "point_decoder.blocks.0.norm1.weight",
    "MapAnything": "info_sharing.blocks.0.norm1.weight",
    "Depth Anything 3 Nested": "model.da3.backbone.pretrained.cls_token",
    "AnySplat": "encoder.aggregator.camera_token",
    "HunyuanWorld-Mirror": "visual_geometry_transformer.camera_token",
}


@pytest.mark.parametrize("name", KEYS)
def test_known_by_a_key(state_dict, config, name):
    expected = f"is a checkpoint of {name}, not of VGGT: .* expected weights of VGGT or Depth Anything 3$"
    with pytest.raises(CheckpointError, match=expected):
        convert_state_dict(state_dict | {KEYS[name]: np.ones(3, np.float32)}, config)


def test_streamvggt_is_known_by_its_name_or_its_content(state_dict, config, tmp_path, monkeypatch):
    with pytest.raises(CheckpointError, match=r"lch01/StreamVGGT is a checkpoint of StreamVGGT, .*causal"):
        locate("lch01/StreamVGGT")  # before anything is downloaded
    path = tmp_path / "stream_vggt.safetensors"
    save_file(state_dict, path)
    with pytest.raises(CheckpointError, match="rename them if they are weights of VGGT"):
        convert(path, tmp_path / "x.safetensors", config=config)
    path = path.rename(tmp_path / "checkpoints.safetensors")
    digest = convert(path, tmp_path / "x.safetensors", config=config).sha256["checkpoints.safetensors"]
    (tmp_path / "x.safetensors").unlink()
    known = [stranger._replace(sha256=(digest,)) if stranger.sha256 else stranger for stranger in FOREIGN]
    monkeypatch.setattr("converters.foreign.FOREIGN", known)
    with pytest.raises(CheckpointError, match="checkpoints is a checkpoint of StreamVGGT"):
        convert(path, tmp_path / "x.safetensors", config=config)
    assert not (tmp_path / "x.safetensors").exists()


def test_vggt_itself_is_no_stranger(golden):
    keys = json.loads((golden / "shapes_vggt_1b.json").read_text())
    for name in ("facebook/VGGT-1B", "facebook/VGGT-1B-Commercial", "model_tracker_fixed_e20", "vggt_1B_commercial"):
        refuse_foreign(name, keys)
    refuse_foreign("ddp", [f"module.{key}" for key in keys])  # unknown keys, but nobody's in particular
