"""Weights of Depth Anything 3 in their published layout: which model they are, and what is refused."""

import dataclasses
import json
import logging

import jax
import numpy as np
import pytest
from safetensors.numpy import save_file

from converters import convert_state_dict
from converters.locate import Weights
from converters.published import published_config
from converters.rules import IGNORED, rules
from converters.torch_to_flax import source_shapes
from tests.shared.da3 import CONFIGS, TINY, published, seeded_weights, shapes
from vggtjax import load_model
from vggtjax.config import DA3, VGGTConfig, vggt_1b
from vggtjax.errors import CheckpointError, InputError
from vggtjax.network.checkpoint import flat_shapes

SHARED = "head.scratch.output_conv2_aux"


@pytest.mark.parametrize("name", CONFIGS)
def test_the_table_names_every_tensor(name):
    config, known = CONFIGS[name], published(dict.fromkeys(shapes(name)))  # type: ignore[arg-type]
    ours = {f"model.{key}" for key in source_shapes(config)}
    assert ours <= set(known)
    assert all(IGNORED["da3"].fullmatch(key.removeprefix("model.")) for key in set(known) - ours)
    assert {key: shapes(name)[key] for key in source_shapes(config)} == source_shapes(config)
    assert {rule.path for rule in rules(config)} >= set(flat_shapes(config))


@pytest.mark.parametrize("name", DA3)
def test_published_sizes(name):
    counts = {"da3-small": 34_299_463, "da3-base": 135_366_599, "da3-large": 410_941_767, "da3-giant": 1_320_045_639}
    kept = sum(int(np.prod(shape)) for shape in flat_shapes(DA3[name]).values())
    assert 0 < counts[name] - kept < 0.012 * counts[name]  # coarser rays, which are read by nothing
    assert VGGTConfig.from_json(DA3[name].to_json()) == DA3[name]


def test_a_file_as_published_and_a_state_dict_in_memory_are_one_model(tmp_path, caplog):
    weights = seeded_weights("tiny")
    save_file(published(weights), tmp_path / "model.safetensors")
    with caplog.at_level(logging.WARNING):
        made = load_model(tmp_path / "model.safetensors", config=TINY)
    assert caplog.messages == []  # its prefix is the usual one
    assert made.heads == ("camera", "depth", "rays")
    in_memory = convert_state_dict(weights, TINY)
    assert jax.tree.all(jax.tree.map(np.array_equal, made.params, in_memory))
    weights[f"{SHARED}.3.2.weight"] = weights[f"{SHARED}.3.2.weight"] + np.float32(1)
    with pytest.raises(CheckpointError, match=rf"has {SHARED}\.3\.2\.weight that differs from {SHARED}\.0\.2\.weight"):
        convert_state_dict(weights, TINY)


def test_the_model_is_known_by_width_or_by_its_own_file(tmp_path):
    place = Weights(tmp_path / "model.safetensors", "some weights")

    def of(width: int) -> VGGTConfig:
        return published_config({"model.backbone.pretrained.camera_token": np.zeros((1, 2, width))}, place)

    assert [of(config.embed_dim) for config in DA3.values()] == list(DA3.values())
    with pytest.raises(CheckpointError, match="some weights is a Depth Anything 3 of 512 channels; expected an any"):
        of(512)
    (tmp_path / "config.json").write_text(json.dumps({"model_name": "da3-base", "config": {"net": {"name": "vitb"}}}))
    assert of(512) == DA3["da3-base"]  # whose shapes are checked next
    (tmp_path / "config.json").write_text("[1]")
    assert of(384) == DA3["da3-small"]
    assert published_config({"aggregator.camera_token": np.zeros(3)}, place) == vggt_1b()
    with pytest.raises(CheckpointError, match=r"for single pictures \(Mono or Metric\), without cameras; expected an"):
        published_config({"model.backbone.pretrained.pos_embed": np.zeros(3)}, place)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"model.da3.backbone.pretrained.cls_token": np.ones(3, np.float32)}, "Depth Anything 3 Nested.*DA3-GIANT-1.1"),
        ({"model.cam_dec.fc_t.bias": None}, "missing key cam_dec.fc_t.bias"),
        ({"model.head.norm.bias": np.ones(3, np.float32)}, r"mis-shaped key head.norm.bias: \[3\], expected \[64\]"),
        ({"model.gs_head.norm.bias": np.ones(3, np.float32)}, None),  # left out
        ({"model.head.other": np.ones(3, np.float32)}, "unknown key head.other"),
        ({"model.backbone.pretrained.norm.bias": np.full(32, np.nan, np.float32)}, "32 of 32 values"),
    ],
)
def test_other_weights(changes, message):
    weights = published(seeded_weights("tiny")) | changes
    weights = {name: value for name, value in weights.items() if value is not None}
    if message is None:
        assert convert_state_dict(weights, TINY).keys() == convert_state_dict(seeded_weights("tiny"), TINY).keys()
        return
    with pytest.raises(CheckpointError, match=message):
        convert_state_dict(weights, TINY)


def test_heads_that_a_family_lacks():
    with pytest.raises(InputError, match=r"heads has \['tracks'\]; expected some of \('camera', 'depth', 'rays'\)"):
        dataclasses.replace(TINY, heads=("camera", "tracks"))
    with pytest.raises(InputError, match="expected depth with rays, which read its maps"):
        dataclasses.replace(TINY, heads=("camera", "rays"))
