"""What the second pass costs and brings: the report by hand, and a small run."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import __main__ as benchmarks
from benchmarks import second_pass as benchmark
from benchmarks.second_pass import Run, camera_errors, report_text
from tests.tiny import tiny_model
from vggtjax.evaluation.metrics.trajectory import centre_error, rotation_error
from vggtjax.method.mask import dynamic_tokens
from vggtjax.network.model import forward
from vggtjax.network.pose import decode_pose
from vggtjax.scenes import SyntheticClip


def test_the_report_by_hand():
    errors = {
        Run("moving", "none", 0): np.array([[4, 0.4], [2, 0.2]]),
        Run("frozen", "none", 0): np.array([[1, 0.1], [1, 0.1]]),
        Run("moving", "the movers'", 5): np.array([[3, 0.2], [1, 0.2]]),
        Run("moving", "another scene's", 5): np.array([[4, 0.4], [4, 0.4]]),
        Run("frozen", "the movers'", 5): np.array([[1.5, 0.1], [1.1, 0.1]]),
        Run("frozen", "another scene's", 5): np.array([[1.5, 0.2], [1.5, 0.2]]),
    }
    text = report_text(errors, "zero")
    assert "Motion costs the plain pass +2.00 ± 1.00 degrees and +0.2000 ± 0.1000 median depths." in text
    assert "5 pairs without the movers' keys win back 50 % of the rotation and 50 % of the centres" in text
    assert "this changes rotations by +30.0 % and centres by +0.0 %" in text
    assert "another scene's mask it is -0.20 ± 0.20 degrees and -0.1000 ± 0.0000 median depths" in text
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| ")]
    assert cells[4] == ["moving", "the movers'", "5", "2.00", "-1.00 ± 0.00", "0.2000", "-0.1000 ± 0.1000"]


def test_errors_of_the_masked_pass():
    """Three clips in a group of four: each has the errors of its own pass."""
    model, generator = tiny_model(), np.random.default_rng(0)
    images = generator.random((3, 3, 28, 28, 3), np.float32)
    poses = np.concatenate([np.tile(np.eye(3), (3, 3, 1, 1)), generator.normal(size=(3, 3, 3, 1))], axis=-1)
    depth, moving = np.tile(np.array([1, 2, 4.0])[:, None, None, None], (1, 3, 28, 28)), np.zeros((3, 3, 28, 28), bool)
    moving[:, :, :14] = True
    clips = SyntheticClip(images, depth, *[None] * 2, moving, None, poses, *[None] * 2)  # type: ignore[arg-type]
    found = camera_errors(model, clips, moving, 2, "zero")
    masked = jax.jit(partial(forward, config=model.config, mask_pairs=2, outputs=("camera",)))
    for clip in range(3):
        tokens = dynamic_tokens(jnp.asarray(moving[clip, None]), model.config.patch_size)
        made = masked(model.params, jnp.asarray(images[clip, None]), dynamic_tokens=tokens)
        cameras = np.asarray(decode_pose(jnp.asarray(made.pose_encoding), (28, 28))[0])[0]
        wanted = rotation_error(cameras, poses[clip]), centre_error(cameras, poses[clip]) / 2**clip
        assert found[clip] == pytest.approx(wanted, rel=1e-3)
    assert np.abs(camera_errors(model, clips, None, 0, "zero") - found).min() > 1e-4


def test_draws_are_joined(tmp_path, capsys, monkeypatch):
    """A stand-in measures: the errors of a draw are its seed."""
    asked = []

    def draw(model, config, scenes, seed, runs, suppress):
        asked.append((config.height, scenes, seed, suppress))
        return ((run, np.full((scenes, 2), seed + (run.scene == "moving"))) for run in runs)

    monkeypatch.setattr(benchmark, "_draw", draw)
    out = tmp_path / "report.md"
    arguments = ["--scenes", "2", "--pairs", "3", "1", "3", "--seed", "4", "--seeds", "2", "--out", str(out)]
    assert benchmarks.main(["second-pass", *arguments]) == 0, capsys.readouterr().err
    shown = capsys.readouterr().out
    assert asked == [(96, 2, 4, "zero"), (96, 2, 5, "zero")]
    assert shown.strip() == out.read_text().strip()
    assert "Means over 4 scenes" in shown
    rows = [[cell.strip() for cell in line.split("|")] for line in shown.splitlines() if line.startswith("| ")][2:]
    assert [row[3] for row in rows] == ["-", "-", *["1"] * 4, *["3"] * 4]
    assert {(row[1], row[4]) for row in rows} == {("moving", "5.50"), ("frozen", "4.50")}


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--scenes", "1"], "scenes is 1; expected at least 2"),
        (["--seeds", "0"], "seeds is 0; expected at least 1"),
        (["--pairs", "0"], "mask_pairs is 0; expected a whole number of at least 1"),
        (["--pairs", "99"], "expected numbers from 1 to 12"),
    ],
)
def test_bad_numbers_are_one_sentence(capsys, arguments, sentence):
    assert benchmarks.main(["second-pass", *arguments]) == 2
    error = capsys.readouterr().err
    assert sentence in error
    assert len(error.strip().splitlines()) == 1
