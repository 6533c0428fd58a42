"""The benchmarks: blind guesses, filmed clips, and a small run of everything."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from benchmarks import __main__ as benchmarks
from benchmarks import speed
from benchmarks.blind_guesses import Prior, compare, guesses, mean_depth_map, training_prior
from benchmarks.real_clips import load_windows, takes, window_starts
from benchmarks.summaries import comparison_table
from tests.benchmarks.rows import row
from tests.tiny import tiny_config
from vggtjax.checkpoint import save_model
from vggtjax.clips.truth import Truth
from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError
from vggtjax.network.model import init_params

SIDE, FRAMES = 28, 3


@pytest.fixture(scope="module")
def config() -> VGGTConfig:
    return tiny_config(image_size=SIDE)


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


def test_windows_cover_takes_and_spread_evenly():
    centres = np.arange(9)[:, None] * np.ones(3)
    assert takes(centres) == [range(9)]
    centres[4:] += 100
    assert takes(centres) == [range(4), range(4, 9)]
    assert window_starts(24, 12) == [0, 12]
    assert window_starts(16, 12) == [0, 4]
    assert window_starts(12, 12) == [0]


def test_filmed_clips_arrive_at_the_models_pixels(tmp_path, config):
    write_clip(tmp_path / "a", frames=8, mask=True, jump_at=4)
    windows = load_windows([tmp_path / "a"], config, FRAMES)
    assert windows.names == ["a 0-2", "a 1-3", "a 4-6", "a 5-7"]
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


def test_filmed_clips_that_do_not_fit_are_one_sentence(tmp_path, config):
    write_clip(tmp_path / "a", frames=3)
    with pytest.raises(InputError, match="a take of 3 frames"):
        load_windows([tmp_path / "a"], config, 4)
    (tmp_path / "a" / "depth" / "00001.png").unlink()
    with pytest.raises(InputError, match=r"00001.png cannot be read"):
        load_windows([tmp_path / "a"], config, 3)
    (tmp_path / "a" / "K.txt").write_text("1 2 three")
    (tmp_path / "a" / "world_from_camera.txt").write_text("1 2")
    with pytest.raises(InputError, match=r"world_from_camera.txt cannot be read"):
        load_windows([tmp_path / "a"], config, 3)


def test_the_prior_is_the_mean_of_training_scenes():
    from vggtjax.scenes import SceneConfig

    config = SceneConfig(height=14, width=14, frames=2)
    seen = []
    prior = training_prior(config, 3, batch=2, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(2, 3), (3, 3)]
    assert prior.depth.shape == (14, 14)
    assert (prior.depth > 0).all()
    assert np.linalg.norm(prior.angular_velocity) < 1
    again = training_prior(config, 3, batch=4)  # batches do not matter
    assert np.allclose(again.depth, prior.depth, rtol=1e-4)


def test_the_mean_map_leaves_out_what_is_not_measured():
    clips = np.array([[[[1.0, 0.0]], [[3.0, 4.0]]], [[[5.0, 8.0]], [[7.0, np.nan]]]])  # 2 clips, 2 frames, 1 x 2 pixels
    assert mean_depth_map(clips).tolist() == [[4.0, 6.0]]
    with pytest.raises(InputError, match="1 pixels have no depth"):
        mean_depth_map(clips * [1, 0])
    with pytest.raises(InputError, match=r"expected clips \[N, S, H, W\]"):
        mean_depth_map(clips[0])


def test_guesses_and_comparisons_by_hand():
    frames = 4
    turned = Rotation.from_rotvec(np.radians([[0, 0, 0], [0, 0, 2], [0, 0, 4], [0, 0, 6]])).as_matrix()
    poses = np.concatenate([turned, -turned @ (np.array([0.0, 1, 2, 3])[:, None, None] * np.eye(3, 1))], axis=2)
    images = np.zeros((1, frames, 2, 2, 3))
    depth = np.tile(np.array([[1.0, 2], [3, 4]]), (1, frames, 1, 1))
    truth = Truth(images, depth, depth[:] < 0, poses[None], np.tile(np.eye(3), (1, frames, 1, 1)))
    flat = Prior(np.ones((2, 2)), np.radians([0, 0, 1]))
    (guess,) = guesses(truth, flat)
    assert guess.mean_depth_map == pytest.approx((1.5 + 0.5 / 2 + 0.5 / 3 + 1.5 / 4) / 4)  # the median is 2.5
    assert guess.no_rotation == pytest.approx((2 + 4 + 6) / 3)
    assert guess.mean_rate == pytest.approx((1 + 2 + 3) / 3)
    assert guess.best_rate == pytest.approx(0, abs=1e-4)
    assert guess.no_motion == pytest.approx(np.sqrt((2.25 + 0.25) / 2))
    assert guess.line == pytest.approx(0, abs=1e-9)

    second = replace(guess, clip=1, no_rotation=2.0)
    rows = [row(clip=0, rotation_error=2.0), row(clip=1, rotation_error=3.0), row(clip=1)]
    found = {(c.metric, c.guess): c for c in compare(rows[:2], [guess, second])}
    rotation = found["rotation_error", "no_rotation"]
    assert (rotation.model_error, rotation.guess_error) == (2.5, 3.0)
    assert rotation.ratio == pytest.approx(2.5 / 3)
    assert (rotation.better, rotation.failed, rotation.passed) == (0.5, 0, False)
    assert replace(rotation, ratio=0.5).passed
    depth_found = found["abs_rel", "mean_depth_map"]
    assert (depth_found.model_error, depth_found.ratio, depth_found.failed, depth_found.passed) == (
        None,
        None,
        2,
        False,
    )
    with_failure = {(c.metric, c.guess): c for c in compare(rows, [guess, second])}["rotation_error", "no_rotation"]
    assert (with_failure.failed, with_failure.clips) == (1, 3)
    assert not replace(with_failure, ratio=0.1).passed
    assert "FAIL" in comparison_table([rotation])


def test_a_small_run_of_everything(tmp_path, config, capsys):
    model = save_model(tmp_path / "tiny.safetensors", init_params(0, config), config)
    write_clip(tmp_path / "clips" / "hololens", frames=13)
    write_clip(tmp_path / "clips" / "composite" / "one", frames=13, mask=True)
    arguments = "--static 2 --dynamic 2 --seeds 1 --frames 12 --mask-pairs 2 --sweep 1 --training-scenes 2 --batch 2"
    arguments += " --height 14"
    out = tmp_path / "out"
    code = benchmarks.main(
        ["demo-model", "--model", str(model), "--out", str(out), "--clips", str(tmp_path / "clips"), *arguments.split()]
    )
    shown = capsys.readouterr()
    assert code == 0, shown.err
    text = (out / "report.md").read_text()
    assert text.strip() in shown.out
    for heading in (
        f"generated ones of {SIDE} x 14 pixels",
        "guesses: static, 2 clips",
        "guesses: hololens, 2 clips",
        "Methods: dynamic",
        "better than vggt",
        "Pairs with suppressed",
    ):
        assert heading in text
    report = json.loads((out / "report.json").read_text())
    assert [c["guess"] for c in report["static"]["comparisons"]] == [
        "mean_depth_map", "no_rotation", "mean_rate", "best_rate", "no_motion", "line",
    ]  # fmt: skip
    assert report["static"]["comparisons"][0]["ratio"] > 0
    assert report["composite"]["clips"] == ["one 0-11", "one 1-12"]
    for name in ("composite ladder", "dynamic"):
        assert len(report[name]["rows"][0]) == 2 * (1 + 3 * 2 * 2 * 2)
        assert len(report[name]["summaries"]) == 1 + 3 * 2 * 2
        assert 0 <= report[name]["saliency_auc"]["mean"] <= 1
    for name in ("rotations", "dynamic-zero", "dynamic-drop", "dynamic-sweep-4dvggt-d", "composite-ladder-zero"):
        with Image.open(out / f"{name}.png") as figure:
            assert min(figure.size) > 300
    assert {path.suffix for path in out.iterdir()} == {".json", ".md", ".png"}


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--model", "{tmp}/none.safetensors"], "none.safetensors"),
        (["--frames", "2"], "frames is 2; expected at least 3"),
        (["--seeds", "0"], "seeds is 0"),
        (["--height", "0"], "height is 0; expected at least 1"),
        (["--height", "50"], "height is 50; expected a multiple of the model's patch size 8"),
        (["--sweep", "3", "-1"], "sweep has [-1]"),
        (["--out", "{tmp}/file/out"], "cannot write"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_code_2(tmp_path, capsys, arguments, sentence):
    (tmp_path / "file").write_text("")
    given = [argument.format(tmp=tmp_path) for argument in ["--out", "{tmp}/out", *arguments]]
    assert benchmarks.main(["demo-model", *given]) == 2
    error = capsys.readouterr().err
    assert error.startswith("benchmarks: ")
    assert sentence in error
    assert len(error.strip().splitlines()) == 1


def test_checkpoints_are_a_subcommand_too(tmp_path):
    shapes = tmp_path / "shapes.json"
    shapes.write_text(json.dumps({"a.weight": [2, 3]}))
    assert benchmarks.main(["make-checkpoint", str(tmp_path / "x.safetensors"), "--shapes", str(shapes)]) == 0
    assert (tmp_path / "x.safetensors").is_file()


def test_depth_that_is_enlarged(tmp_path, capsys):
    x, y = np.meshgrid(np.arange(48), np.arange(32))
    depth = np.where(x > 20, 4000, 1000) + 10 * x + 5 * y
    depth[:4, :4] = 0
    (tmp_path / "clip/depth").mkdir(parents=True)
    Image.fromarray(depth.astype(np.uint16)).save(tmp_path / "clip/depth/0.png")
    assert benchmarks.main(["resolution", "--clips", str(tmp_path), "--factors", "4"]) == 0
    lines = [
        line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("clip ") and "way" not in line
    ]
    rows = {line[1]: float(line[-1].rstrip("%")) for line in lines if line[-1].endswith("%")}
    assert rows["edge-aware"] == rows["nearest"] < rows["bilinear"]
    assert benchmarks.main(["resolution", "--clips", str(tmp_path / "none")]) == 2
    assert "has no clips" in capsys.readouterr().err


def test_how_far_outputs_are_apart():
    theirs = {"depth": np.array([1.0, 3.0]), "pose": np.array([0.0, 2.0]), "mask": np.array([True, False])}
    ours = {"depth": np.array([1.0, 3.1]), "pose": np.array([0.0, 2.0])}
    assert speed._difference(ours, theirs) == pytest.approx(0.1)


def test_every_run_is_in_the_comparison(tmp_path, capsys, monkeypatch):
    """Stand-ins answer: the public side takes twice the time, and more memory where it does not map its weights."""

    class Answering:
        def __init__(self, side, *arguments):
            self.of = 1 if side == "ours" else 2
            self.first = 8 if self.of == 2 and "mapped" not in arguments else self.of

        def __enter__(self):
            return self

        def __exit__(self, *error):
            pass

        def run(self, *, work, frames, keep=None, mask=None, **shape):
            if keep:
                np.savez(keep, pose=np.array([0.0, frames]), mask=np.array([True]))
            return {"seconds": self.of * frames, "total": 1e9, "own": 0, "since start": self.first * 1e9, "reads": 0}

    monkeypatch.setattr(speed, "Worker", Answering)
    for name in ("a", "b", "vggt", "vggt4d"):
        (tmp_path / name).mkdir()
    speed.speed(
        weights=tmp_path / "a",
        converted=tmp_path / "b",
        peer=tmp_path,
        frames=(3,),
        both=(4,),
        repeats=2,
        out=tmp_path / "c.json",
    )
    rows = json.loads((tmp_path / "c.json").read_text())
    assert [(row["work"], row["frames"]) for row in rows] == [("pass", 3), ("vggt4d", 4), ("4dvggt-d", 4)]
    assert [len(row[side]["runs"]) for row in rows for side in ("ours", "public")] == [2] * 6
    shown = [line.split() for line in capsys.readouterr().out.splitlines()]
    (plain,) = (row for row in shown if row[:1] == ["camera"])
    assert " ".join(plain[3:]) == "3 3.00 6.00 0.50 1.00 1.00 1.00 0.00 0.00 - 1.00 8.00 0.12 0.0e+00 no"
    (last,) = (row for row in shown if row[:1] == ["4dvggt-d,"])
    assert " ".join(last[3:]) == "4 4.00 8.00 0.50 1.00 1.00 1.00 0.00 0.00 - - - - - no"


def test_a_comparison_without_the_others_code_is_one_sentence(tmp_path, capsys):
    arguments = ["--weights", tmp_path / "a", "--converted", tmp_path / "b", "--peer", tmp_path]
    assert benchmarks.main(["speed", *map(str, arguments)]) == 2
    assert "a does not exist" in capsys.readouterr().err


def test_ways_to_do_a_pass_are_measured(capsys):
    assert benchmarks.main(["leads", "--frames", "1", "--tokens", "20", "--repeats", "1"]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if "GFLOP" not in line]
    assert sum("attention" in line for line in rows) >= 4
    assert benchmarks.main(["leads", "--repeats", "0"]) == 2
