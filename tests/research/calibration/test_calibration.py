"""The sweep against the cues that it stands for, the greedy choice on planted maps, and what is written of both."""

import dataclasses
import json
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
import pytest
from PIL import Image

from tests.shared.tiny import tiny_config
from vggtjax import init_params, load_model
from vggtjax.config import Cue, MotionConfig
from vggtjax.errors import InputError, OutputError
from vggtjax.interface.commands import calibrate_cues as command
from vggtjax.interface.commands.calibrate_cues import calibrate_cues
from vggtjax.method.cues import GramCues
from vggtjax.method.passes import motion_saliency
from vggtjax.network.checkpoint import Model, save_model
from vggtjax.research.calibration import sweep as sweeps
from vggtjax.research.calibration.choice import candidates, choose, halves
from vggtjax.research.calibration.export import MODEL, NUMBERS, PICTURE, check_folder, save_calibration
from vggtjax.research.calibration.matching import CameBack, matching_pairs
from vggtjax.research.calibration.sweep import DYNAMIC, GRAMS, KINDS, STATIC, Sweep, SweepCues, sweep, token_auc

FRAMES, SIZE, CLIPS = 4, 56, 4


class Moving(NamedTuple):
    """What is read of a generated clip."""

    images: np.ndarray
    dynamic_mask: np.ndarray


@pytest.fixture(scope="module")
def model():
    motion = MotionConfig(offsets=(-2, -1, 1, 2), floor=0.3)
    config = tiny_config(camera_depth=4, camera_num_heads=4, track_features=16, track_hidden=48, motion=motion)
    return Model(config, init_params(0, config), "tiny", note="first attempt", untrained_heads=("tracks",))


@pytest.fixture(scope="module")
def clips():
    """Noise, and a column of other, slightly brighter noise that moves by a patch per frame."""
    generator = np.random.default_rng(0)
    images = generator.uniform(0, 0.5, (CLIPS, 1, SIZE, SIZE, 3)).repeat(FRAMES, axis=1).astype(np.float32)
    masks = np.zeros((CLIPS, FRAMES, SIZE, SIZE), bool)
    for clip, frame in np.ndindex(CLIPS, FRAMES):
        masks[clip, frame, 14 * (clip % 3) :, 14 * frame :][:20, :14] = True
    images[masks] = generator.uniform(0, 0.6, (masks.sum(), 3))
    return images, masks


@pytest.fixture(scope="module")
def swept(model, clips):
    return sweep(model.params, zip(*clips, strict=True), model.config)


@pytest.fixture(scope="module")
def choice(swept):
    return choose(swept, min_gain=0, floor=0.1)


def make_sweep(seed, truth, depth=3):
    maps = np.random.default_rng(seed).normal(size=(len(GRAMS), len(KINDS), depth, *truth.shape)).astype(np.float32)
    saliency = np.random.default_rng(seed).random((2, *truth.shape), np.float32)
    return Sweep(maps, truth, MotionConfig(), saliency, np.zeros((depth, len(truth)), np.float32))


@partial(jax.jit, static_argnames="cues")
def add_all(cues, q, k):
    def pair(sums, layer):
        counts, q, k = layer
        return cues.add(sums, counts, q, k), None

    return jax.lax.scan(pair, cues.zeros(*q.shape[1:4]), (cues.layer_counts(), q, k))[0]


@pytest.fixture(scope="module")
def queries_and_keys():
    """q and k of four pairs, two clips of four frames of six patches, two heads of eight channels."""
    q, k = np.random.default_rng(0).normal(size=(2, 4, 2, 4, 6, 2, 8)).astype(np.float32)
    return q, k


@pytest.mark.parametrize("gram", GRAMS)
def test_maps_and_table_are_those_of_the_cues(queries_and_keys, gram):
    default = MotionConfig()
    every, saliency = SweepCues(default, 4).measured(add_all(SweepCues(default, 4), *queries_and_keys))
    every_map, truth = np.asarray(every[..., 0, :, :])[:, :, :, None], np.zeros((1, 4, 6), np.int8)
    made = Sweep(every_map, truth, default, np.asarray(saliency), np.zeros((4, 1)))
    cues = (*(candidates(4)[i] for i in (0, 5, 10, 15, 23)), Cue("range", "k", "k", (1, 2, 3), "mean"))
    expected = GramCues(MotionConfig(cues, reference_depth=4), 4, gram)
    for name, values in expected.maps(add_all(expected, *queries_and_keys)).items():
        (cue,) = (cue for cue in cues if cue.name == name)
        assert np.allclose(made.map(gram, cue)[0], values[0], atol=1e-5), name
    table = GramCues(default, 4, gram)
    assert np.allclose(saliency[GRAMS.index(gram)], table.saliency(add_all(table, *queries_and_keys)), atol=1e-5)


def test_a_cue_that_the_sweep_does_not_measure_is_named():
    assert [sweeps.kind_index(kind) for kind in KINDS] == list(range(len(KINDS)))
    with pytest.raises(InputError, match="cue 'other' is the mean of k with q; the sweep has only qq_mean, qq_std"):
        sweeps.kind_index(Cue("other", "k", "q", (0,), "mean"))


def test_pairs_match_whose_matches_come_back(queries_and_keys):
    """Two of four pairs match: keys are the queries of the other frames, moved by one patch."""
    q, k = (np.array(x) for x in queries_and_keys)
    q[1:3] *= 3
    k[1:3] = q[1:3] = q[1:3, :, :1]  # the same tokens in all frames
    shares = add_all(CameBack(4, (2, 3)), q, k)
    assert np.allclose(shares[1:3], 1)
    assert (shares[::3] < 0.7).all()
    assert matching_pairs(np.asarray(shares)) == (1, 2)
    assert matching_pairs(np.full((4, 2), 0.2)) is None


def test_truth_of_tokens_by_hand():
    mask = np.zeros((1, 4, 6), bool)
    mask[0, :2, :2] = True  # all four pixels
    mask[0, 0, 2:4] = True  # two of four
    mask[0, 2, 0] = True  # one of four
    assert sweeps.token_truth(mask, 2).tolist() == [[DYNAMIC, DYNAMIC, STATIC, sweeps.UNCLEAR, STATIC, STATIC]]


def test_unclear_tokens_do_not_count():
    truth = np.array([[[DYNAMIC, STATIC, STATIC, sweeps.UNCLEAR]]], np.int8)
    assert token_auc(np.array([[[0.5, 0.1, 0.9, 1.0]]]), truth) == 0.5


def test_a_planted_map_is_chosen_first():
    kinds, generator = [STATIC, DYNAMIC, sweeps.UNCLEAR], np.random.default_rng(0)
    truth = generator.choice(kinds, (4, 3, 20), p=(0.6, 0.3, 0.1)).astype(np.int8)
    planted = make_sweep(1, truth)
    planted.maps[0, 3, 1] = -1 * (truth == DYNAMIC)  # of similarity "cosine" only
    chosen = choose(planted)
    assert chosen.motion.cues == (Cue("layer1_kk_std", "k", "k", (1,), "std", inverted=True),)
    assert (chosen.steps[0].rating, chosen.motion.reference_depth) == ((1, 1), 3)
    assert choose(planted, gram="dot").motion.cues[0].name != "layer1_kk_std"


def test_a_cue_that_brings_nothing_stays_for_the_cue_after_it():
    """Three moving tokens of six, of which one is the question: the second map settles it on one clip only."""
    truth = np.array([[[1, 1, 1, 0, 0, 0]], [[1, 1, 1, 0, 0, 0]]], np.int8)
    made = make_sweep(0, truth, depth=1)._replace(maps=np.zeros((2, 6, 1, 2, 1, 6), np.float32))
    first, second, third = made.maps[0, :3, 0, :, 0]
    first[:] = (9, 9, 5, 7, 6, 0)
    second[:] = (4, 4, 4, 1, 4, 4), (4, 4, 4, 4, 4, 1)
    third[:] = (4, 4, 4, 4, 1, 4)
    ratings = [(7 / 9, 7 / 9), (8 / 9, 7 / 9), (1, 8 / 9)]
    chosen = choose(made, min_gain=0.02)
    assert np.array([step.rating for step in chosen.steps]) == pytest.approx(np.array(ratings))
    assert [step.cue.name for step in chosen.steps] == ["layer0_qq_mean", "layer0_qq_std", "layer0_kk_mean"]
    assert len(choose(made, min_gain=0.06).steps) == 1  # two cues would have to bring 0.12, and bring 0.11
    assert len(choose(made, max_terms=2).steps) == 1


def test_ratings_are_those_of_the_method(model, clips, swept, choice):
    run = jax.jit(motion_saliency, static_argnames=("config", "motion"))
    saliency = np.asarray(run(model.params, clips[0], model.config, motion=choice.motion))
    for start, rating in enumerate(choice.steps[-1].rating):
        values = saliency[start::2].reshape(2, FRAMES, -1)
        assert token_auc(values, halves(swept)[start].truth) == pytest.approx(rating, abs=2e-3)
    assert len(choice.steps) > 1  # of a single cue the floor changes no order
    assert swept.table == MotionConfig(offsets=model.config.motion.offsets)  # without the model's own floor
    assert choice.motion.offsets == model.config.motion.offsets


def test_a_calibrated_model_knows_its_table(tmp_path, model, swept, choice):
    path = save_calibration(tmp_path / "out", model, swept, choice, source={"scenes": CLIPS})
    loaded = load_model(path)
    assert loaded.config == dataclasses.replace(model.config, motion=choice.motion)
    assert (loaded.name, loaded.note, loaded.untrained_heads) == ("tiny", model.note, model.untrained_heads)
    assert (loaded.params["aggregator"]["camera_token"] == model.params["aggregator"]["camera_token"]).all()
    numbers = json.loads((tmp_path / "out" / NUMBERS).read_text())
    assert numbers["source"] == {"scenes": CLIPS}
    assert len(numbers["choice"]["steps"]) == len(choice.steps)
    assert MotionConfig(**numbers["choice"]["motion"]) == choice.motion
    assert np.allclose([row["auc_of_layers"] for row in numbers["sweep"]], swept.auc().reshape(-1, 4), atol=1e-6)
    halves = [numbers["clips"][half] for half in ("calibration", "held_out")]
    assert sum(half["clips"] for half in halves) == CLIPS
    assert sum(v for half in halves for k, v in half.items() if k.endswith("tokens")) == swept.truth.size
    with Image.open(tmp_path / "out" / PICTURE) as picture:
        assert picture.width > 600
    save_calibration(tmp_path / "out", loaded, swept, choice)  # replaces the earlier one
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == sorted((MODEL, NUMBERS, PICTURE))


def test_another_model_is_not_replaced(tmp_path, model, swept, choice):
    (tmp_path / MODEL).write_text("weights")
    with pytest.raises(OutputError, match="not part of an earlier calibration"):
        save_calibration(tmp_path, model, swept, choice)
    (tmp_path / NUMBERS).write_text('{"format": "something else"}')
    with pytest.raises(OutputError, match="not part of an earlier calibration"):
        check_folder(tmp_path)
    assert (tmp_path / MODEL).read_text() == "weights"


def test_clips_and_models_that_do_not_fit(model, clips):
    images, masks = clips
    with pytest.raises(InputError, match="a clip has 1 frame; expected at least two"):
        sweep(model.params, zip(images[:, :1], masks[:, :1], strict=True), model.config)
    broken = model.params | {"aggregator": model.params["aggregator"] | {"camera_token": np.full((2, 1, 16), np.nan)}}
    with pytest.raises(InputError, match="not finite"):
        sweep(broken, zip(*clips, strict=True), model.config)


def test_the_command(tmp_path, model, clips, capsys, monkeypatch):
    wanted = []
    monkeypatch.setattr(command, "generated_clips", lambda *a: wanted.append(a) or map(Moving, *clips))
    source = save_model(tmp_path / "tiny.safetensors", model.params, model.config)
    calibrate_cues(str(source), tmp_path / "out", scenes=CLIPS, frames=FRAMES, max_terms=2, floor=0.2, seed=5)
    assert wanted == [(CLIPS, FRAMES, SIZE, 5)]
    loaded = load_model(tmp_path / "out" / MODEL)
    assert 1 <= len(loaded.config.motion.cues) <= 2
    assert (loaded.config.motion.reference_depth, loaded.config.motion.floor) == (4, 0.2)
    printed = capsys.readouterr()
    assert loaded.config.motion.cues[0].name in printed.out
    assert "default table" in printed.out
    assert "air of blocks matches frames" in printed.out or "airs of blocks that match frames" in printed.out
    assert "sweep" in printed.err
    with pytest.raises(InputError, match="size is 50"):
        calibrate_cues(str(source), tmp_path / "other", size=50)
    assert not (tmp_path / "other").exists()
