"""The benchmark of a model: blind guesses by hand, filmed clips in windows, and a small run of everything."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from benchmarks import __main__ as benchmarks
from benchmarks import blind_guesses, demo_model
from benchmarks.blind_guesses import (
    Prior,
    best_angular_velocity,
    compare,
    guesses,
    mean_angular_velocity,
    mean_depth_map,
    turning,
)
from benchmarks.real_clips import load_windows, window_starts
from benchmarks.summaries import comparison_table
from tests.benchmarks.scenes import SIDE, drawn_scenes, row, tiny_file
from tests.tiny import tiny_config
from vggtjax.clips.truth import Truth
from vggtjax.errors import InputError
from vggtjax.evaluation.metrics.trajectory import rotation_error
from vggtjax.scenes import SceneConfig, SyntheticClip

FRAMES = 3


def write_clip(folder, frames=FRAMES, mask=False, jump_at=None) -> None:
    """A filmed clip as the benchmark expects it: 56 x 56 pixels, depth 1000 + 10 x column millimetres."""
    generator = np.random.default_rng(0)
    for name in ("rgb", "depth", *(["mask"] if mask else [])):
        (folder / name).mkdir(parents=True)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(0.1 * np.arange(frames)[:, None] * [0, 1, 0.3]).as_matrix()
    poses[:, :3, 3] = 0.1 * np.arange(frames)[:, None] + 0.03 * generator.normal(size=(frames, 3))
    if jump_at is not None:
        poses[jump_at:, :3, 3] += 50
    for frame in range(frames):
        Image.fromarray(generator.integers(0, 255, (56, 56, 3), np.uint8)).save(folder / f"rgb/{frame:05}.png")
        depth = np.tile(1000 + 10 * np.arange(56, dtype=np.uint16), (56, 1))
        depth[:8] = 0
        Image.fromarray(depth).save(folder / f"depth/{frame:05}.png")
        if mask:
            moving = np.zeros((56, 56), np.uint8)
            moving[20:40, 10 + frame : 30 + frame] = 255
            Image.fromarray(moving).save(folder / f"mask/{frame:05}.png")
    np.savetxt(folder / "world_from_camera.txt", poses.reshape(frames, 16))
    np.savetxt(folder / "K.txt", [[50, 0, 28], [0, 50, 28], [0, 0, 1]])


def test_filmed_clips_arrive_at_the_models_pixels(tmp_path):
    config = tiny_config(image_size=SIDE)
    assert [window_starts(count, 12) for count in (24, 16, 12)] == [[0, 12], [0, 4], [0]]
    write_clip(tmp_path / "a", frames=8, mask=True, jump_at=4)
    windows = load_windows(tmp_path, config, FRAMES)
    assert windows.names == ["a 00000-00002", "a 00001-00003", "a 00004-00006", "a 00005-00007"]
    truth = windows.truth
    assert truth.images.shape == (4, FRAMES, SIDE, SIDE, 3)
    # Half the size: the centre of clip pixel x is the edge between columns 2 x and 2 x + 1, and the right one is taken.
    assert np.allclose(truth.depth[0, 0, 4:], (1 + 0.01 * (2 * np.arange(SIDE) + 1))[None])
    assert not truth.depth[:, :, :4].any()
    assert truth.dynamic_mask[1, 0, 12, 6:15].all()
    assert not truth.dynamic_mask[1, 0, 12, :5].any()
    assert np.allclose(truth.intrinsics[0, 0], [[25, 0, 14], [0, 25, 14], [0, 0, 1]])
    rows = np.loadtxt(tmp_path / "a" / "world_from_camera.txt").reshape(-1, 4, 4)
    identity = np.concatenate([truth.camera_from_world[2, 1], [[0, 0, 0, 1]]]) @ rows[5]
    assert np.allclose(identity, np.eye(4))
    with pytest.raises(InputError, match="has 4 frames; choose --frames of at most that"):
        load_windows(tmp_path / "a", config, 5)
    (tmp_path / "a/K.txt").unlink()
    with pytest.raises(InputError, match=r"it has no K.txt; expected depth/, K.txt and cameras"):
        load_windows(tmp_path, config, FRAMES)


def test_the_mean_map_leaves_out_what_is_not_measured():
    clips = np.array([[[[1.0, 0.0]], [[3.0, 4.0]]], [[[5.0, 8.0]], [[7.0, np.nan]]]])  # 2 clips, 2 frames, 1 x 2 pixels
    assert mean_depth_map(clips).tolist() == [[4.0, 6.0]]
    with pytest.raises(InputError, match="1 pixels have no depth"):
        mean_depth_map(clips * [1, 0])


def test_the_prior_is_the_mean_of_training_scenes(monkeypatch):
    def drawn(key, textures, config):
        depth = jax.random.uniform(key, (config.frames, config.height, config.width), minval=1.0)
        turned = jnp.stack([jnp.eye(3), jnp.asarray([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])])
        poses = jnp.concatenate([turned, jnp.zeros((2, 3, 1))], axis=2)
        return SyntheticClip(depth, depth, *[None] * 4, poses, *[None] * 2)  # type: ignore[arg-type]

    monkeypatch.setattr(blind_guesses, "generate", drawn)
    monkeypatch.setattr(blind_guesses, "load_textures", lambda split: None)
    config = SceneConfig(height=14, width=14, frames=2)
    seen = []
    prior = blind_guesses.training_prior(config, 3, batch=2, progress=lambda done, total: seen.append((done, total)))
    depths = [np.asarray(drawn(key, None, config).depth) for key in jax.random.split(jax.random.key(0), 4)[:3]]
    assert np.allclose(prior.depth, np.mean(depths, axis=(0, 1)))
    assert np.degrees(prior.angular_velocity) == pytest.approx([0, 0, 90])
    assert seen == [(2, 3), (3, 3)]


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
    assert np.degrees(mean_angular_velocity(poses)) == pytest.approx([0, 0, 2])

    second = replace(guess, clip=1, no_rotation=2.0)
    rows = [row(clip=0, rotation_error=2.0), row(clip=1, rotation_error=3.0), row(clip=1)]
    found = {(c.metric, c.guess): c for c in compare(rows[:2], [guess, second])}
    rotation = found["rotation_error", "no_rotation"]
    assert (rotation.model_error, rotation.guess_error) == (2.5, 3.0)
    assert rotation.ratio == pytest.approx(2.5 / 3)
    assert (rotation.better, rotation.failed, rotation.passed) == (0.5, 0, False)
    assert replace(rotation, ratio=0.5).passed
    missing = found["abs_rel", "mean_depth_map"]
    assert (missing.model_error, missing.ratio, missing.failed, missing.passed) == (None, None, 2, False)
    with_failure = {(c.metric, c.guess): c for c in compare(rows, [guess, second])}["rotation_error", "no_rotation"]
    assert (with_failure.failed, with_failure.clips) == (1, 3)
    assert not replace(with_failure, ratio=0.1).passed
    assert "FAIL" in comparison_table([rotation])


def test_the_oracle_is_the_median_rate_in_a_plane():
    """About one axis the mean angle is sum |t_i w - a_i| / N: a weighted median, whose minimum is found exactly."""
    angles = np.radians([3, 5, 12, 10, 20])
    truth = np.tile(np.eye(3, 4), (6, 1, 1))
    truth[:, :, :3] = Rotation.from_rotvec(np.r_[0, angles][:, None] * [0, 0, 1]).as_matrix()
    times = np.arange(1, 6)
    exact = min(np.abs(times * rate - angles).mean() for rate in angles / times)
    found = rotation_error(turning(best_angular_velocity(truth), 6), truth)
    assert np.radians(found) == pytest.approx(exact, rel=1e-4)


def test_a_small_run_of_everything(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(demo_model, "held_out_scenes", drawn_scenes)
    monkeypatch.setattr(demo_model, "SUPPRESS", ("zero",))

    prior = Prior(np.full((SIDE, SIDE), 2.0), np.array([0, 0.1, 0]))
    monkeypatch.setattr(demo_model, "training_prior", lambda config, scenes, progress: prior)
    write_clip(tmp_path / "clips/hololens", frames=3)
    write_clip(tmp_path / "clips/composite/one", frames=5, mask=True)
    out, small = tmp_path / "out", "--static 2 --dynamic 2 --seeds 1 --frames 3 --mask-pairs 2 --sweep 1"
    files = ["--model", str(tiny_file(tmp_path)), "--out", str(out), "--clips", str(tmp_path / "clips")]
    code = benchmarks.main(["demo-model", *files, *small.split()])
    shown = capsys.readouterr()
    assert code == 0, shown.err
    text = (out / "report.md").read_text()
    assert text.strip() in shown.out
    for heading in (
        f"generated ones of {SIDE} x {SIDE} pixels",
        "guesses: static, 2 clips",
        "guesses: hololens, 1 clips",
        "Methods: dynamic",
        "better than vggt",
        "Pairs with suppressed",
    ):
        assert heading in text
    report = json.loads((out / "report.json").read_text())
    assert [c["guess"] for c in report["static"]["comparisons"]] == [
        "mean_depth_map", "no_rotation", "mean_rate", "best_rate", "no_motion", "line",
    ]  # fmt: skip
    assert report["composite"]["clips"] == ["one 00000-00002", "one 00002-00004"]
    for name in ("composite ladder", "dynamic"):
        assert len(report[name]["rows"][0]) == 2 * (1 + 3 * 2 * 2)
        assert len(report[name]["summaries"]) == 1 + 3 * 2
    for name in ("dynamic-zero", "dynamic-sweep-4dvggt-d", "composite-ladder-zero"):
        with Image.open(out / f"{name}.png") as figure:
            assert min(figure.size) > 300
