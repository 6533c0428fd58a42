"""Fitted trees in files: what comes back is what went in, and what is none is one sentence."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from tests.shared.simulated import scattered
from tests.shared.tiny import tiny_config
from vggtjax.errors import InputError
from vggtjax.method.fusion.family import parse_family, start
from vggtjax.method.fusion.file import load_fusion, origin_of_fit, save_fusion, warn_if_fitted_otherwise
from vggtjax.network.checkpoint import Model
from vggtjax.options import Options
from vggtjax.storage.tensor_file import read_tensors


@pytest.mark.parametrize("family", ["full", "gate"])
def test_round_trip(tmp_path, family):
    params = scattered(start(parse_family(family), seed=3))
    save_fusion(tmp_path / "a.safetensors", params, {"family": family})
    back = load_fusion(tmp_path / "a.safetensors")
    assert jax.tree.structure(back) == jax.tree.structure(params)
    assert jax.tree.all(jax.tree.map(np.array_equal, back, params))
    assert json.loads(read_tensors(tmp_path / "a.safetensors").metadata["about"]) == {"family": family}


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda tree: tree.pop("power"), "has power of shape None"),
        (lambda tree: tree.update(power=np.ones(3, np.float32)), r"has power of shape \(3,\); expected \(2,\)"),
        (lambda tree: tree.update(more=np.ones(3, np.float32)), "has more of shape"),
        (lambda tree: tree.update(scale=np.full(2, np.nan, np.float32)), "values of scale that are not finite"),
        (lambda tree: tree.update(floor=np.full(2, -1, np.float32)), r"has floor \[-1.0, -1.0\]; expected values in"),
    ],
)
def test_what_is_no_tree_is_one_sentence(tmp_path, change, sentence):
    path = tmp_path / "a.safetensors"
    save_fusion(path, start(()))
    tree, metadata = load_file(path), read_tensors(path).metadata
    change(tree)
    save_file(tree, path, metadata)
    with pytest.raises(InputError, match=sentence):
        load_fusion(path)


def test_other_files_are_one_sentence(tmp_path):
    (tmp_path / "text").write_text("no tensors")
    with pytest.raises(InputError, match="fit-fusion wrote"):
        load_fusion(tmp_path / "text")
    save_file({"x": np.ones(3, np.float32)}, tmp_path / "other.safetensors")
    with pytest.raises(InputError, match="is not a fitted fusion"):
        load_fusion(tmp_path / "other.safetensors")


def test_other_models_and_settings_are_warned_of(tmp_path, caplog):
    """The model by its digest, not by its name; and every option of the passes."""
    path = tmp_path / "a.safetensors"
    model, other = (Model(tiny_config(), {"x": np.full(2, value)}, "mine") for value in (1.0, 2.0))
    renamed = dataclasses.replace(model, name="models/renamed.safetensors")
    digest, others = model.identity.sha256, other.identity.sha256
    assert renamed.identity.sha256 == digest
    for about, user, warning in (
        ({"model": "mine", "model_sha256": digest, "mask_pairs": 5}, renamed, None),
        ({"model": "mine", "model_sha256": digest}, other, f"mine (sha256 {digest[:8]}) mine (sha256 {others[:8]})"),
        ({"model": "mine", "mask_pairs": 3}, other, "3 5"),
    ):
        caplog.clear()
        save_fusion(path, start(()), about)
        warn_if_fitted_otherwise(path, user, Options(align_scale=True))
        assert [f"{record.args[2]} {record.args[3]}" for record in caplog.records] == ([warning] if warning else [])


def test_every_option_of_the_passes_is_compared_and_the_type_of_the_weights_is_not(tmp_path, caplog):
    path = tmp_path / "a.safetensors"
    model = Model(tiny_config(), {"x": np.full(2, 1.5, np.float32)}, "mine")
    narrow = dataclasses.replace(model, params={"x": model.params["x"].astype(jax.numpy.bfloat16)})
    for fitted, used in ((model, narrow), (narrow, model)):
        save_fusion(path, start(()), origin_of_fit(fitted, Options()))
        warn_if_fitted_otherwise(path, used, Options(gram="cosine", refine_mask=True))
    assert not caplog.records
    other = Options(
        gram="dot", suppress="drop", mask_pairs=2, threshold="multi-otsu", align_scale=True, smooth_frames=3,
        compute_dtype="float64",
    )  # fmt: skip
    warn_if_fitted_otherwise(path, model, other)
    names = {"gram", "suppress", "mask_pairs", "threshold", "align_scale", "smooth_frames", "compute_dtype"}
    assert {record.args[1] for record in caplog.records} == names  # pyright: ignore
