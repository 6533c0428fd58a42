import hashlib
import re
from pathlib import Path

import jax
import numpy as np
import pytest

from vggtjax import load_model
from vggtjax.errors import CheckpointError, ClipError
from vggtjax.pipeline.pretrained import embedded as demo
from vggtjax.training.scenes.held_out import MOVERS

DOCS = Path(__file__).parents[3] / "docs"


def test_the_model_is_the_documented_one():
    digest = hashlib.sha256(demo.MODEL.read_bytes()).hexdigest()
    assert digest in (DOCS / "research-notes" / "embedded-model.md").read_text()
    model = demo.demo_model()
    assert model.note.endswith("not for real footage")
    assert model.summary()["heads"] == ["camera", "depth", "points (untrained)", "tracks (untrained)"]
    assert model.dtype == "float32"
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(model.params))


def test_the_clip_fits_the_model_and_moves():
    clip, config = demo.demo_clip(), demo.demo_model().config
    S, H, W = clip.depth.shape
    assert clip.images.shape == (S, H, W, 3)
    assert H % config.patch_size == W % config.patch_size == 0
    assert S >= 12
    assert clip.images.min() >= 0
    assert clip.images.max() <= 1
    assert MOVERS[0] <= clip.dynamic_mask.mean() <= MOVERS[1]
    rotation = clip.camera_from_world[:, :, :3]
    assert np.allclose(rotation @ rotation.transpose(0, 2, 1), np.eye(3), atol=1e-5)


def test_a_broken_installation_says_so(monkeypatch, tmp_path):
    monkeypatch.setattr(demo, "MODEL", tmp_path / "nothing.safetensors")
    with pytest.raises(CheckpointError, match=re.escape("is missing; install vggtjax again")):
        demo.demo_model()
    with pytest.raises(ClipError, match=re.escape("is missing; install vggtjax again")):
        demo.demo_clip(tmp_path / "nothing.npz")


def test_what_is_no_name_of_a_model_is_named():
    for name in (None, 3, {"params": {}}, b"demo"):
        with pytest.raises(CheckpointError, match=f"named by a {type(name).__name__}; expected a path or a name"):
            load_model(name)  # type: ignore
