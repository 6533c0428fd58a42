"""Checkpoints of VGGT's relatives are refused by name, and VGGT's own are not."""

import json

import numpy as np
import pytest
from safetensors.numpy import save_file

from converters import convert, convert_state_dict
from converters.foreign import FOREIGN, refuse_foreign
from converters.locate import locate
from vggtjax.errors import CheckpointError

# Keys as the networks' public code builds them.
KEYS = {
    "PAGE-4D": "aggregator.spatial_mask_head.head0.0.weight",
    "VGGT-Omega": "aggregator.inter_frame_blocks.0.norm1.weight",
    "OmniVGGT": "aggregator.camera_adapters.0.weight",
    "Pi3": "point_decoder.blocks.0.norm1.weight",
    "MapAnything": "info_sharing.blocks.0.norm1.weight",
    "Depth Anything 3": "model.backbone.pretrained.cls_token",
    "AnySplat": "encoder.aggregator.camera_token",
    "HunyuanWorld-Mirror": "visual_geometry_transformer.camera_token",
}


@pytest.mark.parametrize("name", KEYS)
def test_known_by_a_key(state_dict, config, name):
    with pytest.raises(CheckpointError, match=f"is a checkpoint of {name}, not of VGGT: .* expected weights of VGGT$"):
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
