"""Refinement of cameras through the whole reconstruction."""

import numpy as np
import pytest

pytest.importorskip("pycolmap", reason="needs the extra colmap")

from tests.shared.corner import corner_result, make_corner, paint
from tests.shared.tiny import tiny_model
from vggtjax import load_clip, reconstruct
from vggtjax.options import Options
from vggtjax.pipeline.agreement import agree_with_pixels
from vggtjax.pipeline.known.options import KnownGeometry
from vggtjax.progress import StageSeconds
from vggtjax.research.evaluation.metrics.trajectory import rotation_error


@pytest.fixture(scope="module")
def model():
    return tiny_model()


@pytest.mark.filterwarnings("ignore:the field of view")
def test_the_option_and_its_outcome_reach_the_result(model, tmp_path):
    clip = load_clip(paint(make_corner(3, 0.5)), size=56)
    times = StageSeconds()
    known = KnownGeometry(intrinsics="170,170,96,72", baseline="0,2,1.5")
    result = reconstruct(model, clip, method="vggt", refine_cameras=True, known=known, on_stage=times.stage)
    assert "refine cameras" in times.seconds
    assert result.settings["refine_cameras"] is True
    outcome = result.settings["refined_cameras"]
    assert outcome["frames"] == 3
    assert result.known_facts["cameras"] == outcome["sentence"]
    np.testing.assert_allclose(result.intrinsics[:, [0, 1], [0, 1]], 170 * 56 / 192, rtol=0.02)  # the known ones
    assert np.linalg.norm(np.subtract(*result.camera_centres[[0, 2]])) == pytest.approx(1.5, rel=1e-4)
    result.save(tmp_path / "out", only=("report",))
    assert outcome["sentence"] in (tmp_path / "out" / "report.html").read_text().replace("-&gt;", "->")
    assert "refine_cameras" not in Options().to_json()


def test_refined_points_are_fitted_by_consistent_depth_too():
    corner = make_corner(4, 0.7)
    pictures, predicted = paint(corner), corner_result(corner, degrees=2)
    options = Options(refine_cameras=True, consistent_depth=True)
    made = agree_with_pixels(predicted, lambda: iter(pictures), options)
    assert made.settings["consistency"]["points"] > 100
    assert list(made.known_facts) == ["cameras", "depth"]
    before, after = (rotation_error(each.camera_from_world, corner.camera_from_world) for each in (predicted, made))
    assert after < 0.1 * before
