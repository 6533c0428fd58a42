"""The configuration and the options: checked values, the key of the passes, and the keywords of public functions."""

import dataclasses
import json
import re
import subprocess
import sys

import numpy as np
import pytest

from vggtjax import VGGTConfig
from vggtjax.config import MotionConfig
from vggtjax.errors import InputError
from vggtjax.options import METHODS, Options

MOTION = MotionConfig()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"method": "best"}, "method is 'best'; expected one of vggt, vggt4d"),
        ({"mask_pairs": -1}, "mask_pairs is -1; expected a whole number of at least 0"),
        ({"mask_pairs": 10**12}, "mask_pairs is 1000000000000; expected at most 1000000"),
        ({"smooth_frames": 2}, "smooth_frames is 2; expected an odd number"),
    ],
)
def test_invalid_values(changes, message):
    with pytest.raises(InputError, match=message):
        Options(**changes)


def test_numbers_of_numpy_become_plain_numbers():
    options = Options(mask_pairs=np.int64(3), smooth_frames=np.int64(3))  # pyright: ignore[reportArgumentType]
    assert options == Options(mask_pairs=3, smooth_frames=3)
    assert json.loads(json.dumps(options.to_json())) == options.to_json()


def test_the_passes_depend_on_all_options_but_those_of_the_assembly():
    """A new option is one of them unless it is named there."""
    other = {"gram": "dot", "suppress": "drop", "mask_pairs": 2, "smooth_frames": 3, "compute_dtype": "bfloat16"}
    other |= {"threshold": "multi-otsu", "mask": "matches"}
    # Absent where it is exact, as are the precision where it is the highest, masks of the papers, chosen references.
    other |= {"attention": "sampled", "reference": "first"}
    fields = {field.name for field in dataclasses.fields(Options)}
    key = Options().passes_settings(MOTION)
    named = fields - {"method", "align_scale", "refine_mask", "refine_cameras", "consistent_depth"} | {"clusters"}
    assert set(key) == named - {"attention", "precision", "mask", "reference"}
    assert set(Options(attention="sampled").passes_settings(MOTION)) == named - {"precision", "mask", "reference"}
    assert Options("4dvggt-m").passes_settings(MOTION) == Options(mask="matches").passes_settings(MOTION)
    assert Options("4dvggt-m", mask="gram").passes_settings(MOTION) == key
    assert "attention" not in Options().to_json()
    assert all(Options(**{name: value}).passes_settings(MOTION) != key for name, value in other.items())
    exact = Options(align_scale=True, refine_mask=True, refine_cameras=True, consistent_depth=True)
    assert exact.passes_settings(MOTION) == key
    same = {name for name in METHODS if Options(name).passes_settings(MOTION) == key}  # pyright: ignore[reportArgumentType]
    assert same == set(METHODS) - {"vggt4d", "4dvggt-m"}


def test_the_method_fills_in_what_is_not_given():
    cpu = Options(compute_dtype="float32", precision="highest")
    made = Options("vggt4d").resolved(MOTION)
    mining = {"gram": "dot", "threshold": "multi-otsu", "refine_mask": True, "mask": "gram"}
    wanted = cpu.changed(method="vggt4d", suppress="drop", mask_pairs=5, **mining)
    assert made == wanted
    assert Options("vggt4d", gram="cosine", refine_mask=False).resolved(MOTION).gram == "cosine"


@pytest.mark.parametrize("option", [{"smooth_frames": 3}, {"threshold": "otsu"}])
def test_options_of_mined_masks_are_refused_with_given_ones(option):
    with pytest.raises(InputError, match=f"{next(iter(option))} is .*; leave it out, as given masks"):
        Options(**option).check_given_masks()


def test_a_model_recommends_pairs_and_a_threshold_and_given_options_overrule_it():
    model = MotionConfig(mask_pairs=2, threshold="multi-otsu")
    for options, motion, pairs, threshold in (
        (Options(), model, 2, "multi-otsu"),
        (Options(mask_pairs=0, threshold="otsu"), model, 0, "otsu"),
        (Options(), MOTION, 5, "otsu"),
        (Options("vggt4d"), MOTION, 5, "multi-otsu"),
    ):
        made = options.resolved(motion)
        assert (made.mask_pairs, made.threshold) == (pairs, threshold)
    assert Options().passes_settings(model) == Options(mask_pairs=2, threshold="multi-otsu").passes_settings(MOTION)


def test_a_result_names_a_threshold_that_is_not_the_methods():
    given = (Options(), Options("vggt4d"), Options("vggt4d", threshold="otsu"))
    assert [options.resolved(MOTION).to_json().get("threshold") for options in given] == [None, None, "otsu"]


@pytest.mark.parametrize(
    ("given", "dtype", "precision"),
    [
        ({}, "bfloat16", "tf32"),
        ({"precision": "highest"}, "float32", "highest"),
        ({"compute_dtype": "float32"}, "float32", "tf32"),
        ({"compute_dtype": "bfloat16", "precision": "highest"}, "bfloat16", "highest"),
    ],
)
def test_the_platform_fills_in_how_exact_the_network_is(monkeypatch, given, dtype, precision):
    monkeypatch.setattr("jax.default_backend", lambda: "gpu")
    made = Options(**given).resolved(MOTION)
    assert (made.compute_dtype, made.precision) == (dtype, precision)
    assert made.resolved(MOTION) == made
    assert Options(**given).passes_settings(MOTION)["compute_dtype"] == dtype
    on_cpu = Options(**given).resolved(MOTION, on_accelerator=False)
    assert (on_cpu.compute_dtype, on_cpu.precision) == (given.get("compute_dtype", "float32"), "highest")


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"taps": (4, 11, 17, 24)}, "below depth 24"),
        ({"depth": 0}, "depth is 0; expected a whole number of at least 1"),
        ({"heads": ("depth", "camera")}, "in this order"),
        ({"heads": ("depth", "nose")}, r"heads has \['nose'\]; expected some of \('camera', 'depth'"),
        ({"embed_dim": 1000}, "embed_dim 1000 is not a multiple"),
        ({"dpt_channels": (4, 4, 4, 6)}, "of 4"),
        ({"motion": {"offsets": (0,)}}, "offsets other than 0"),
    ],
)
def test_bad_values_are_named(change, sentence):
    with pytest.raises(InputError, match=sentence):
        VGGTConfig(**change)


def test_bad_cues_are_named():
    cue = json.loads(VGGTConfig().to_json())["motion"]["cues"][0]
    for change, sentence in (
        ({"layers": [24]}, "cue 'shallow_kk_mean' has layers (24,)"),
        ({"layers": []}, "motion.cues[0].layers is []"),
        ({"rows": "v"}, "motion.cues[0].rows is 'v'; expected one of"),
        ({"row": "k"}, "motion.cues[0] has unknown fields ['row']"),
    ):
        with pytest.raises(InputError, match=re.escape(sentence)):
            MotionConfig(cues=(cue | change,))  # pyright: ignore[reportArgumentType]: mappings become cues


@pytest.mark.parametrize(
    ("modules", "late"),
    [
        ("vggtjax.interface.commands.main, vggtjax.config, vggtjax.clips.clip", ["jax", "gradio"]),
        (
            "vggtjax.interface.commands.reconstruct, vggtjax.pipeline.run",
            ["scipy.spatial", "scipy.ndimage", "scipy.linalg", "skimage.segmentation", "skimage.morphology"],
        ),
    ],
)
def test_what_takes_long_to_import_is_imported_where_it_is_used(modules, late):
    code = f"import sys, {modules}; print([name for name in {late} if name in sys.modules])"
    ran = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert ran.stdout == "[]\n"
