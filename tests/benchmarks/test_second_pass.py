"""What the second pass costs and brings: the report by hand, errors of a pass, and draws that are joined."""

import numpy as np
import pytest

from benchmarks import __main__ as benchmarks
from benchmarks import second_pass as benchmark
from benchmarks.second_pass import Run, camera_errors, report_text
from tests.tiny import tiny_model
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
    text = report_text(errors, "Two scenes.")
    assert text.startswith("Two scenes. Changes are")
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| ")]
    assert cells[4] == ["moving", "the movers'", "5", "2.00", "-1.00 ± 0.00", "0.2000", "-0.1000 ± 0.1000"]
    facts = {(row[0], row[1], row[2].split(" ")[0]): row[3:] for row in cells if len(row) == 5}
    assert facts["moving", "-", "cost"] == ["+2.00 ± 1.00", "+0.2000 ± 0.1000"]
    assert facts["moving", "-", "the"] == ["+66.7 ± 11.1 %", "+66.7 ± 11.1 %"]
    # the changes are -1, -1 of 3, 1, and -0.2, 0 of 0.3, 0.1: residuals -1/2, 1/2 and -0.05, 0.05
    assert facts["moving", "5", "change"] == ["-50.0 ± 25.0 %", "-50.0 ± 25.0 %"]
    assert facts["moving", "5", "another"] == ["+2.00 ± 1.00", "+0.2000 ± 0.0000"]
    assert facts["frozen", "5", "change"] == ["+30.0 ± 20.0 %", "+0.0 ± 0.0 %"]
    assert facts["frozen", "5", "another"] == ["+0.20 ± 0.20", "+0.1000 ± 0.0000"]


def test_errors_of_the_masked_pass():
    """Three clips in a group of four: each has the errors of its own pass."""
    model, generator = tiny_model(), np.random.default_rng(0)
    images = generator.random((3, 3, 28, 28, 3), np.float32)
    poses = np.concatenate([np.tile(np.eye(3), (3, 3, 1, 1)), generator.normal(size=(3, 3, 3, 1))], axis=-1)
    moving = np.zeros((3, 3, 28, 28), bool)
    moving[:, :, :14] = True
    clips = SyntheticClip(images, np.ones(moving.shape), *[None] * 2, moving, None, poses, *[None] * 2)  # type: ignore[arg-type]
    found = camera_errors(model, clips, moving, 2, "zero")
    for clip in range(3):
        alone = clips._replace(
            images=images[[clip]],
            depth=clips.depth[[clip]],
            dynamic_mask=moving[[clip]],
            camera_from_world=poses[[clip]],
        )
        assert camera_errors(model, alone, moving[[clip]], 2, "zero")[0] == pytest.approx(found[clip], rel=1e-3)
    assert np.abs(camera_errors(model, clips, ~moving, 2, "zero") - found).min() > 1e-4


def test_draws_are_joined(tmp_path, capsys, monkeypatch):
    """Stand-ins draw and measure: a scene's error is its seed, and 10 with a mask of its own."""
    measured = []

    def draw(kind, count, config, seed):
        number = np.full(count, seed + 0.5 * config.frozen)
        return SyntheticClip(number, *[None] * 3, np.array(["first", "second"]), *[None] * 4)  # type: ignore[arg-type]

    def measure(model, clips, mask, pairs, suppress):
        measured.append((pairs, None if mask is None else mask.tolist(), suppress))
        own = mask is not None and mask.tolist() == clips.dynamic_mask.tolist()
        return np.stack([clips.images + 10 * own] * 2, axis=1)

    monkeypatch.setattr(benchmark, "held_out_scenes", draw)
    monkeypatch.setattr(benchmark, "camera_errors", measure)
    out = tmp_path / "report.md"
    arguments = ["second-pass", "--scenes", "2", "--pairs", "3", "1", "3", "--seeds", "2", "--out"]
    assert benchmarks.main([*arguments, str(out)]) == 0, capsys.readouterr().err
    shown = capsys.readouterr().out
    assert shown.strip() == out.read_text().strip()
    own, lent = ["first", "second"], ["second", "first"]
    assert measured[:4] == [(0, None, "zero")] * 2 + [(1, own, "zero"), (1, lent, "zero")]
    rows = [[cell.strip() for cell in line.split("|")] for line in shown.splitlines() if line.startswith("| ")]
    rotations = {tuple(row[1:4]): row[4] for row in rows if len(row) == 9}
    assert [rotations[kind, "none", "-"] for kind in ("moving", "frozen")] == ["0.50", "1.00"]
    assert [rotations["frozen", mask, "3"] for mask in ("the movers'", "another scene's")] == ["11.00", "1.00"]
