"""The benchmark of a model: blind guesses and summaries by hand, filmed clips in windows, a small run of everything."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import __main__ as benchmarks
from benchmarks import demo_model, embed, held_out
from benchmarks.blind_guesses import Prior, compare, guesses, mean_depth_map
from benchmarks.real_clips import Windows, load_windows, window_starts
from benchmarks.summaries import changes_table, comparison_table, ladder_table, saliency_auc, spread, summarise
from tests.benchmarks.scenes import SIDE, drawn_scenes, row, tiny_file
from tests.shared.da3 import TINY
from tests.shared.dataset_files import write_plain
from tests.shared.tiny import tiny_config
from vggtjax.clips.truth import Truth
from vggtjax.errors import InputError
from vggtjax.network.checkpoint import Model
from vggtjax.network.model import init_params
from vggtjax.training.scenes import SceneConfig

FRAMES = 3


def write_clip(folder, frames=FRAMES, jump_at=0) -> None:
    """A filmed clip as the benchmark expects it: 56 x 56 pixels, depth 1 + column / 100 metres."""
    generator = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(0.1 * np.arange(frames)[:, None] * [0, 1, 0.3]).as_matrix()
    poses[:, :3, 3] = 0.1 * np.arange(frames)[:, None] + 0.03 * generator.normal(size=(frames, 3))
    poses[jump_at:, :3, 3] += 50
    depth = np.tile(1 + np.arange(56) / 100, (frames, 56, 1))
    depth[:, :8] = 0
    moving = np.zeros((frames, 56, 56), bool)
    for frame in range(frames):
        moving[frame, 20:40, 10 + frame : 30 + frame] = True
    images, K = generator.random((frames, 56, 56, 3)), np.array([[50.0, 0, 28], [0, 50, 28], [0, 0, 1]])
    write_plain(folder, Truth(images, depth, moving, np.linalg.inv(poses)[:, :3], np.tile(K, (frames, 1, 1))))


def test_filmed_clips_arrive_at_the_models_pixels(tmp_path):
    config = tiny_config(image_size=SIDE)
    assert [window_starts(count, 12) for count in (24, 16, 12)] == [[0, 12], [0, 4], [0]]
    write_clip(tmp_path / "a", frames=8, jump_at=4)
    windows = load_windows(tmp_path, config, FRAMES)
    assert windows.names == ["a 00000-00002", "a 00001-00003", "a 00004-00006", "a 00005-00007"]
    truth = windows.truth
    assert truth.images.shape == (4, FRAMES, SIDE, SIDE, 3)
    # Half the size: the centre of clip pixel x is the edge between columns 2 x and 2 x + 1, and the right one is taken.
    assert np.allclose(truth.depth[0, 0, 4:], (1 + 0.01 * (2 * np.arange(SIDE) + 1))[None])
    assert not truth.depth[:, :, :4].any()
    assert np.flatnonzero(truth.dynamic_mask[1, 0, 12])[[0, -1]] == pytest.approx([5.5, 15], abs=1)
    assert np.allclose(truth.intrinsics[0, 0], [[25, 0, 14], [0, 25, 14], [0, 0, 1]])
    world_from_camera = np.loadtxt(tmp_path / "a" / "world_from_camera.txt").reshape(-1, 4, 4)[5]
    assert np.allclose(truth.camera_from_world[2, 1] @ world_from_camera, np.eye(3, 4))
    with pytest.raises(InputError, match="has 4 frames; choose --frames of at most that"):
        load_windows(tmp_path / "a", config, 5)
    (tmp_path / "a/K.txt").unlink()
    with pytest.raises(InputError, match=r"it has no K.txt; expected .*K.txt; expected depth/, K.txt and cameras"):
        load_windows(tmp_path, config, FRAMES)


def test_guesses_and_comparisons_by_hand():
    frames = 4
    turned = Rotation.from_rotvec(np.radians([[0, 0, 0], [0, 0, 2], [0, 0, 4], [0, 0, 6]])).as_matrix()
    poses = np.concatenate([turned, -turned @ (np.array([0.0, 1, 2, 3])[:, None, None] * np.eye(3, 1))], axis=2)
    images = np.zeros((1, frames, 2, 2, 3))
    depth = np.tile(np.array([[1.0, 2], [3, 4]]), (1, frames, 1, 1))
    truth = Truth(images, depth, depth[:] < 0, poses[None], np.tile(np.eye(3), (1, frames, 1, 1)))
    (guess,) = guesses(truth, Prior(np.ones((2, 2)), np.radians([0, 0, 1])))
    assert guess.mean_depth_map == pytest.approx((1.5 + 0.5 / 2 + 0.5 / 3 + 1.5 / 4) / 4)  # the median is 2.5
    assert guess.no_rotation == pytest.approx((2 + 4 + 6) / 3)
    assert guess.mean_rate == pytest.approx((1 + 2 + 3) / 3)
    assert guess.best_rate == pytest.approx(0, abs=1e-4)
    assert guess.no_motion == pytest.approx(np.sqrt((2.25 + 0.25) / 2))
    assert guess.line == pytest.approx(0, abs=1e-9)
    measured_in_part = np.array([[[[1.0, 0.0]], [[3.0, 4.0]]], [[[5.0, 8.0]], [[7.0, np.nan]]]])
    assert mean_depth_map(measured_in_part).tolist() == [[4, 6]]

    rows = [row(clip=0, rotation_error=2.0), row(clip=1, rotation_error=3.0), row(clip=1)]
    compared = compare(rows, [guess, replace(guess, clip=1, no_rotation=3.5)])
    found = {(each.metric, each.guess): each for each in compared}
    rotation, missing = found["rotation_error", "no_rotation"], found["abs_rel", "mean_depth_map"]
    assert (rotation.model_error, rotation.guess_error, rotation.ratio) == (2.5, 3.75, pytest.approx(2.5 / 3.75))
    assert (rotation.better, rotation.failed, rotation.clips, rotation.passed) == (pytest.approx(2 / 3), 1, 3, False)
    assert replace(rotation, ratio=0.5, failed=0).passed
    assert not replace(rotation, ratio=0.1).passed  # a clip failed
    assert (missing.model_error, missing.ratio, missing.failed, missing.passed) == (None, None, 3, False)
    assert "FAIL" in comparison_table([rotation])


@pytest.mark.proof
def test_a_small_run_of_everything(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(held_out, "held_out_scenes", drawn_scenes)
    monkeypatch.setattr(demo_model, "SUPPRESS", ("zero",))
    prior = Prior(np.full((SIDE, SIDE), 2.0), np.array([0, 0.1, 0]))
    monkeypatch.setattr(demo_model, "training_prior", lambda config, scenes, progress: prior)
    write_clip(tmp_path / "clips/composite/one", frames=4)
    out, small = tmp_path / "out", "--static 1 --dynamic 1 --seeds 1 --frames 3 --mask-pairs 2 --sweep 1"
    files = ["--model", str(tiny_file(tmp_path)), "--out", str(out), "--clips", str(tmp_path / "clips")]
    code = benchmarks.main(["demo-model", *files, *small.split()])
    shown = capsys.readouterr()
    assert code == 0, shown.err
    assert (out / "report.md").read_text().strip() in shown.out
    for heading in ("guesses: static, 1 clips", "Methods: dynamic", "better than vggt", "Pairs with suppressed"):
        assert heading in shown.out
    report = json.loads((out / "report.json").read_text())
    assert report["composite"]["clips"] == ["one 00000-00002", "one 00001-00003"]
    assert len(report["composite ladder"]["rows"][0]) == 2 * (1 + 3 * 2 * 2)
    assert len(report["dynamic"]["summaries"]) == 1 + 3 * 2
    for name in ("dynamic-zero", "dynamic-sweep-4dvggt-d", "composite-ladder-zero"):
        assert (out / f"{name}.png").is_file()


def test_known_cameras_are_compared_with_none(monkeypatch):
    monkeypatch.setattr(demo_model, "training_prior", lambda *_, **__: Prior(np.full((SIDE, SIDE), 2.0), np.zeros(3)))
    config = replace(TINY, image_size=SIDE)
    bench = demo_model._Bench(
        Model(config, init_params(0, config), "reader"), demo_model.Settings(2, 0, 1, FRAMES, None, None, (), 1, None)
    )
    truth = Truth(
        *(getattr(drawn_scenes("static", 2, SceneConfig(SIDE, SIDE, FRAMES)), name) for name in Truth._fields)
    )
    plain, told = bench.compared("static", Windows(["a", "b"], truth)).known_cameras
    assert (plain.method, told.method, told.clips) == ("vggt", "known cameras", 2)
    assert plain.changes == {}
    change = told.scores["abs_rel"].mean - plain.scores["abs_rel"].mean
    assert change != 0
    assert told.changes["abs_rel"].mean == pytest.approx(change)


def test_summaries_by_hand():
    plain = [row(clip=0, abs_rel=0.2, saliency_auc=0.5), row(clip=1, abs_rel=0.4, saliency_auc=0.7)]
    setting = {"method": "4dvggt-d", "mask_source": "mined", "mask_pairs": 5, "suppress": "zero"}
    masked = [row(clip=0, abs_rel=0.1, **setting), row(clip=1, failure="odd", **setting)]
    by_seed = [plain + masked, [*plain[:1], row(clip=0, abs_rel=0.3, **setting)]]
    first, second = summarise(by_seed)
    assert (first.method, first.mask_source, first.clips, first.failed) == ("vggt", None, 3, 0)
    assert first.scores["abs_rel"].mean == pytest.approx((0.3 + 0.2) / 2)
    assert first.scores["abs_rel"].deviation == pytest.approx(0.1 / np.sqrt(2))
    assert (second.clips, second.failed) == (3, 1)
    assert second.scores["abs_rel"].mean == pytest.approx((0.1 + 0.3) / 2)
    assert second.ratios["abs_rel"].mean == pytest.approx((0.1 / 0.2 + 0.3 / 0.2) / 2)
    assert "rotation_error" not in second.scores
    assert saliency_auc(by_seed) == spread([0.6, 0.5])
    assert [spread([0.25]).text(), spread([1, 3]).text(2)] == ["0.250", "2.00 ± 1.41"]
    assert "1 failed" in ladder_table([first, second]).splitlines()[3]


def test_changes_by_hand():
    masked = {"mask_source": "true", "mask_pairs": 5, "suppress": "zero"}

    def rows(method, *errors, **setting):
        return [row(clip=clip, method=method, rotation_error=error, **setting) for clip, error in enumerate(errors)]

    draws = [
        rows("vggt", 4, 2) + rows("pose-decoupling", 3, 2, **masked) + rows("4dvggt-d", 1, 2, **masked),
        rows("vggt", 1, 5) + rows("pose-decoupling", 1, 4, **masked) + rows("4dvggt-d", 2, None, **masked),
    ]
    plain, decoupled, ours = summarise(draws)
    assert plain.changes == {}
    change = decoupled.changes["rotation_error"]
    assert (change.mean, change.share) == (-0.5, -0.5 / 3)
    assert change.error == pytest.approx(np.std([-1, 0, 0, -1], ddof=1) / 2)
    # in draw 2 all methods have the first clip alone: a tie with vggt
    assert (change.better, change.best, change.draws) == (2, 1, 2)
    assert ours.changes["rotation_error"].mean == pytest.approx((-3 + 0 + 1) / 3)
    assert "| -0.500 ± 0.289 (-16.7 %); 2/2, 1/2 " in changes_table([plain, decoupled, ours])


def test_the_second_pass_over_clips_and_the_typical_one():
    def rows(*errors, **setting):
        known = [row(clip=clip, rotation_error=e, centre_error_ratio=0.02, **setting) for clip, e in enumerate(errors)]
        return [*known, row(clip=len(errors), rotation_error=1.0, **setting)]  # a camera that stands does not count

    first, second = rows(1.0, 2.0, 3.0), rows(1.0, 1.0, 2.5, method="4dvggt-d", mask_source="mined")
    known = embed._known([*second, *first])
    many = embed.second_pass_over(known)
    assert many.clips == 3
    assert list(many.changes) == ["mined"]
    change = many.changes["mined"]["rotation_error"]  # differences of 0, -1 and -0.5 degrees over a mean of 2
    assert change == pytest.approx((-0.25, 0.25 / 3**0.5))
    assert embed._typical_scene(known) == 1
    with pytest.raises(InputError, match="0 scenes have errors of their cameras"):
        embed._known(rows())
