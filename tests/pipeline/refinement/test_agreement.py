"""Consistent depth through whole reconstructions: the option, several methods, and long clips."""

from typing import Any

import numpy as np
import pytest

from tests.pipeline.windows.walk import CONFIG, FRAMES, SETTINGS, plan_of, tools_of, walk, window_result, windows_of
from tests.shared.corner import make_corner, paint
from vggtjax import Reconstruction, load_clip, reconstruct
from vggtjax.options import Options
from vggtjax.pipeline import agreement
from vggtjax.pipeline.known.options import KnownGeometry
from vggtjax.pipeline.refinement.consistent import ConsistencyReport
from vggtjax.pipeline.several import reconstruct_methods
from vggtjax.pipeline.windows import run as windows
from vggtjax.progress import StageSeconds


@pytest.mark.filterwarnings("ignore:the field of view")
@pytest.mark.parametrize(
    ("option", "kept", "fact", "rtol"),
    [("consistent_depth", "consistency", "depth", 1e-6), ("refine_cameras", "refined_cameras", "cameras", 0.02)],
)
def test_the_option_and_its_outcome_reach_the_result(model, tmp_path, option, kept, fact, rtol):
    if option == "refine_cameras":
        pytest.importorskip("pycolmap", reason="needs the extra colmap")
    clip, times = load_clip(paint(make_corner(3, 0.5)), size=56), StageSeconds()
    known = KnownGeometry(intrinsics="170,170,96,72", baseline="0,2,1.5")
    chosen: Any = {option: True}
    result = reconstruct(model, clip, method="vggt", known=known, on_stage=times.stage, **chosen)
    assert option.replace("_", " ") in times.seconds
    assert result.settings[option] is True
    sentence = result.settings[kept]["sentence"]
    assert result.known_facts[fact] == sentence
    np.testing.assert_allclose(result.intrinsics[:, [0, 1], [0, 1]], 170 * 56 / 192, rtol=rtol)  # the known ones
    assert np.linalg.norm(np.subtract(*result.camera_centres[[0, 2]])) == pytest.approx(1.5, rel=1e-4)
    result.save(tmp_path / "out", only=("report",))
    assert sentence[:40] in (tmp_path / "out" / "report.html").read_text().replace("-&gt;", "->")
    assert option not in Options().to_json()
    if option == "consistent_depth":  # which several methods can have at once
        together = reconstruct_methods(model, clip, ("vggt",), **chosen)["vggt"]
        alone = reconstruct(model, clip, method="vggt", **chosen)
        assert together.settings == alone.settings
        np.testing.assert_array_equal(together.depth, alone.depth)


def test_a_long_clip_is_made_consistent_after_its_windows_are_joined(tmp_path, monkeypatch):
    images, seen = np.asarray(walk().images), []

    def recorded(result, pictures, **_):
        seen.append((len(result.depth), len(list(pictures))))
        return result, ConsistencyReport(False)

    def run(clip):
        return window_result(clip, 0, np.zeros((FRAMES, CONFIG.height, CONFIG.width), bool))

    monkeypatch.setattr(agreement, "consistent_depth", recorded)
    for consistent in (False, True):
        plan, out = plan_of(), tmp_path / str(consistent)
        windows.run_windows(images, out, windows_of(loops=False), plan, tools_of(run), SETTINGS, consistent=consistent)
    assert seen == [(FRAMES, FRAMES)]
    made = [Reconstruction.load(tmp_path / str(consistent)) for consistent in (False, True)]
    assert ["consistent_depth" in each.settings for each in made] == [False, True]
