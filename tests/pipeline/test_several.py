"""Several methods as one by one, the plain first pass, which makes no mask, and arguments of another class."""

import dataclasses
from contextlib import contextmanager

import numpy as np
import pytest

from tests.shared.scored_room import room_and_truth
from tests.shared.tiny import tiny_model
from vggtjax import load_clip
from vggtjax.errors import InputError
from vggtjax.options import Options
from vggtjax.pipeline.run import compile_ahead, reconstruct
from vggtjax.pipeline.several import reconstruct_methods
from vggtjax.progress import StageSeconds
from vggtjax.research.evaluation.protocol import score
from vggtjax.research.evaluation.truth_at_pixels import TruthAtPixels
from vggtjax.results.reconstruction import Reconstruction

METHODS = ("4dvggt-d", "vggt4d")


@pytest.mark.filterwarnings("ignore:the field of view")
def test_methods_at_once_are_methods_one_by_one(model, clip):
    stages = []

    @contextmanager
    def on_stage(name):
        stages.append(name)
        yield None

    made = reconstruct_methods(model, clip, METHODS, on_stage=on_stage)
    assert tuple(made) == METHODS
    assert stages.count("first pass") == stages.count("second pass") == 2  # vggt4d mines and suppresses in its own way
    for method, result in made.items():
        alone = reconstruct(model, clip, method=method)
        assert (result.method, result.settings) == (method, alone.settings)
        for name in ("depth", "depth_confidence", "camera_from_world", "intrinsics", "dynamic_mask", "saliency"):
            np.testing.assert_allclose(getattr(result, name), getattr(alone, name), rtol=1e-5, atol=1e-6, err_msg=name)
        assert result.passes is None


CLIP = np.zeros((2, 56, 56, 3), np.uint8)


def test_arguments_in_the_wrong_place_are_named():
    model = tiny_model()
    for run, message in (
        (lambda: reconstruct(CLIP, model), r"model is ndarray .*; expected what load_model returned: reconstruct\(mod"),  # type: ignore
        (lambda: reconstruct("demo", CLIP), "model is str 'demo'; expected what load_model returned"),  # type: ignore
        (lambda: reconstruct(model.params, CLIP), "model is dict"),  # type: ignore
        (lambda: reconstruct(model, CLIP, options="vggt"), "options is str 'vggt'; .* its fields by name"),  # type: ignore
        (lambda: reconstruct(model, CLIP, options=Options), "options is Options; expected Options"),  # type: ignore
        (lambda: reconstruct(model, CLIP, running={"devices": 1}), "running is dict"),  # type: ignore
        (lambda: reconstruct(model, CLIP, known={"baseline": 1}), "known is dict .*; expected KnownGeometry"),  # type: ignore
        (lambda: reconstruct(model, CLIP, tracks=[[1, 2]]), "tracks is list"),  # type: ignore
        (lambda: compile_ahead("demo", 2, 56, 56), "model is str 'demo'"),  # type: ignore
        (lambda: reconstruct_methods(CLIP, model, ["vggt"]), "model is ndarray"),  # type: ignore
    ):
        with pytest.raises(InputError, match=message):
            run()


@pytest.fixture(scope="module")
def small(model):
    images = np.random.default_rng(3).integers(0, 255, (4, 28, 42, 3), np.uint8)
    return load_clip(images, model=model, size=42)


def test_a_result_of_one_pass_has_no_mask_and_the_same_depth_and_cameras(model, small, tmp_path):
    stages = StageSeconds()
    alone = reconstruct(model, small, method="vggt", size=42, on_stage=stages.stage)
    assert "first pass" in stages.seconds
    assert "dynamic mask" not in stages.seconds
    used = reconstruct(model, small, method="vggt", is_part=True, size=42)
    both = reconstruct_methods(model, small, ["vggt", "4dvggt-d"], size=42)
    assert used.dynamic_mask.any()
    for result in (alone, both["vggt"]):
        assert not result.has_mask
        assert not result.dynamic_mask.any()
        assert result.saliency is result.motion is None
        assert result.settings["masks"] == "none: vggt makes no mask"
        assert repr(result).endswith("no mask)")
    for name in ("depth", "depth_confidence", "camera_from_world", "intrinsics"):
        np.testing.assert_array_equal(getattr(alone, name), getattr(used, name))
    assert both["4dvggt-d"].has_mask
    np.testing.assert_array_equal(both["4dvggt-d"].dynamic_mask, used.dynamic_mask)

    alone.save(tmp_path / "out", format="vggt4d")
    there = {path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out").rglob("*")}
    assert not [name for name in there if "mask" in name or "instances" in name or "overlay" in name]
    assert not Reconstruction.load(tmp_path / "out").has_mask
    assert not Reconstruction.load(tmp_path / "out/vggt4d", format="vggt4d", quaternion="wxyz").has_mask
    page = (tmp_path / "out/report.html").read_text()
    assert "of the pixels," not in page
    assert "plain values stand" not in page


@pytest.mark.parametrize("empty", [False, True])
def test_masks_that_are_given_stay(model, small, empty):
    given = np.zeros(small.images.shape[:3], bool)
    given[:, :14, :14] = not empty
    result = reconstruct(model, small, method="vggt", size=42, masks=given)
    assert result.has_mask
    np.testing.assert_array_equal(result.dynamic_mask, given)
    assert not reconstruct(model, small, method="vggt", size=42, refine_mask=True).has_mask


def test_neither_new_nor_older_results_of_one_pass_get_j_and_f():
    room, sequence = room_and_truth()
    for masks, scored in (("mined", False), ("none: vggt makes no mask", False), ("given", True)):
        result = dataclasses.replace(room, method="vggt", settings={"masks": masks})
        scores = score(result, TruthAtPixels(sequence, room))
        assert ("j_mean" in scores.metrics) == ("saliency_auc" in scores.metrics) == scored
        assert ("masks: the result has no masks" in scores.notes) == (not scored)
        assert scores.metrics["ate"] < 1e-4
    other = dataclasses.replace(room, method="4dvggt-d", settings={"masks": "mined"})
    assert score(other, TruthAtPixels(sequence, room)).metrics["j_mean"] == 1
