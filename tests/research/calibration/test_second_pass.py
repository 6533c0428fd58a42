"""Threshold and number of pairs of the second pass: chosen by errors of cameras, kept in the model, used by default."""

import dataclasses
import json
from functools import partial

import numpy as np
import pytest

from tests.shared.tiny import tiny_config
from vggtjax import init_params, load_model, reconstruct
from vggtjax.config import MotionConfig, VGGTConfig
from vggtjax.errors import InputError
from vggtjax.interface.commands.calibrate_cues import calibrate_cues, generated_clips
from vggtjax.method.soft_mask import soft_masking
from vggtjax.network.checkpoint import Model, save_model
from vggtjax.options import METHODS, pairs_to_try
from vggtjax.research.calibration.choice import Choice, Rating
from vggtjax.research.calibration.export import calibrated
from vggtjax.research.calibration.second_pass import CameraErrors, SecondPassChoice, Setting, choose_second_pass
from vggtjax.research.evaluation.ladder import LadderRow, ladder
from vggtjax.research.evaluation.sources import ModelSource

FRAMES, SIZE, SCENES = 4, 56, 2  # of 16 patches, which the two thresholds cut differently


@pytest.fixture(scope="module")
def model():
    config = tiny_config(motion=MotionConfig(offsets=(-1, 1)))
    return Model(config, init_params(0, config), "tiny")


def test_the_smallest_sum_of_shares_of_the_first_pass():
    first, better, worse = CameraErrors(4.0, 0.02), CameraErrors(3.0, 0.022), CameraErrors(2.9, 0.03)
    one, three, other = Setting(1, "otsu"), Setting(3, "otsu"), Setting(1, "multi-otsu")
    assert SecondPassChoice(8, first, {one: worse, three: better}).best == three  # 0.75 + 1.1 against 0.725 + 1.5
    assert SecondPassChoice(8, first, {one: worse, three: worse, other: worse}).best == one  # the first of equal ones


def test_errors_are_those_of_the_second_pass(model):
    clips = list(generated_clips(SCENES, FRAMES, SIZE, seed=1))
    found = choose_second_pass(model, clips, [2, 1])
    assert list(found.errors) == [(1, "otsu"), (2, "otsu"), (1, "multi-otsu"), (2, "multi-otsu")]
    assert len(set(found.errors.values())) == 4
    setting = Setting(1, "multi-otsu")
    ways = {"masks": ["mined"], "mask_pairs": [setting.pairs], "threshold": setting.threshold}
    rows = [ladder(model, clip, methods=["vggt", "4dvggt-d"], **ways) for clip in clips]
    errors = np.array([[(row.rotation_error, row.centre_error_ratio) for row in each] for each in rows], float)
    scored = errors[np.isfinite(errors).all((1, 2))]
    assert found.scenes == len(scored) > 0
    np.testing.assert_allclose([found.first, found.errors[setting]], np.mean(scored, axis=0), rtol=1e-4)


@pytest.mark.parametrize(("gram", "suppress"), [("cosine", "zero"), ("dot", "drop")])
def test_keys_are_suppressed_as_in_the_method_with_these_cues(model, monkeypatch, gram, suppress):
    def stand_in(model, clip, **settings):
        assert settings["suppress"] == [METHODS["vggt4d" if gram == "dot" else "4dvggt-d"].suppress] == [suppress]
        assert settings["gram"] == gram
        return [LadderRow(0, "vggt", None, pairs, None, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1) for pairs in (None, 1)]

    monkeypatch.setattr("vggtjax.research.calibration.second_pass.ladder", stand_in)
    assert choose_second_pass(model, [None], [1], gram=gram).best == (1, "otsu")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(("pairs", "found"), [([], r"\[\]"), ([5], r"\[5\]; .* from 1 to 4")])
def test_numbers_that_a_model_does_not_have(model, pairs, found):
    with pytest.raises(InputError, match=found):
        pairs_to_try(pairs, model.config.depth)


def test_a_model_recommends_its_threshold_and_number(model, tmp_path):
    config = tiny_config(motion=MotionConfig(offsets=(-1, 1), threshold="multi-otsu", mask_pairs=1))
    assert not {"threshold", "mask_pairs"} & json.loads(model.config.to_json())["motion"].keys()
    assert VGGTConfig.from_json(config.to_json()) == config
    loaded = load_model(save_model(tmp_path / "one.safetensors", model.params, config))
    clip = np.asarray(next(generated_clips(1, FRAMES, SIZE, seed=1)).images)
    run = partial(reconstruct, clip=clip, size=SIZE)
    made, asked, plain = run(loaded), run(model, threshold="multi-otsu", mask_pairs=1), run(model)
    for found in (made, asked):
        assert (found.settings["threshold"], found.settings["mask_pairs"]) == ("multi-otsu", 1)
        assert not np.array_equal(found.camera_from_world, plain.camera_from_world)
    assert np.array_equal(made.dynamic_mask, asked.dynamic_mask)
    assert np.array_equal(made.camera_from_world, asked.camera_from_world)
    assert "threshold" not in plain.settings
    assert not np.array_equal(made.dynamic_mask, plain.dynamic_mask)
    settings = ModelSource(loaded, ["4dvggt-d"]).settings
    assert (settings["threshold"], settings["mask_pairs"]) == ("multi-otsu", 1)
    assert "threshold" not in ModelSource(model, ["4dvggt-d"]).settings
    assert soft_masking(config).strength.sum() == 1
    assert soft_masking(model.config).strength.sum() == 4
    assert soft_masking(model.config, motion=config.motion).strength.sum() == 1


@pytest.mark.parametrize(
    ("gram", "threshold", "written"),
    [("cosine", "multi-otsu", "multi-otsu"), ("cosine", "otsu", None), ("dot", "otsu", "otsu")],
)
def test_the_chosen_setting_is_written(model, gram, threshold, written):
    motion = dataclasses.replace(model.config.motion, threshold="multi-otsu")  # of an earlier calibration
    choice = Choice(motion, gram, (), None, Rating(0.5, 0.5))
    assert calibrated(model, choice).config.motion == motion
    found = calibrated(model, choice, Setting(3, threshold)).config.motion
    assert (found.mask_pairs, found.threshold) == (3, written)


@pytest.mark.proof
def test_the_command(model, tmp_path, capsys):
    path = save_model(tmp_path / "tiny.safetensors", model.params, model.config)
    out = tmp_path / "out"
    calibrate_cues(str(path), out, scenes=4, frames=FRAMES, size=SIZE, max_terms=1, mask_pairs=(1, 2))
    told = json.loads((out / "calibration.json").read_text())["second_pass"]
    assert [row["pairs"] for row in told["errors"]] == [1, 2, 1, 2]
    motion = load_model(out / "model.safetensors").config.motion
    assert json.loads((out / "calibration.json").read_text())["choice"]["motion"]["mask_pairs"] == motion.mask_pairs
    assert motion.mask_pairs == told["recommended"]["pairs"]
    assert (motion.threshold or "otsu") == told["recommended"]["threshold"]
    assert len(motion.cues) == 1
    assert "recommended" in capsys.readouterr().out
    with pytest.raises(InputError, match=r"mask_pairs is 0; expected"):  # before the model is looked for
        calibrate_cues("nowhere.safetensors", tmp_path / "other", mask_pairs=(0, 3))
    assert not (tmp_path / "other").exists()
