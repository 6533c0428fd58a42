"""What `vggtjax export` writes, read back as a capture and as the ground truth of the result itself."""

import json
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.shared.room import make_room
from vggtjax.cameras import world_from_camera
from vggtjax.clips.captures.table import read_capture
from vggtjax.clips.clip import load_clip
from vggtjax.interface.commands import main as cli
from vggtjax.pipeline.known.poses import read_poses
from vggtjax.results.exports.table import Exporting
from vggtjax.results.exports.views import rigid
from vggtjax.results.exports.write import export_result

FORMS = ("colmap", "colmap-text", "gsplat", "nerfstudio")
FRAMES, H, W = 4, 42, 56


def needed(form):
    if form not in ("nerfstudio", "tum", "kitti"):
        pytest.importorskip("pycolmap")


@pytest.mark.parametrize("form", [*FORMS, "tum", "kitti"])
@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_cameras_survive_the_way_out_and_back(tmp_path, form, size):
    needed(form)
    random = np.random.default_rng(0)
    rotation = Rotation.random(2, rng=random).as_matrix()
    poses = np.concatenate([rotation, size * random.normal(size=(2, 3, 1))], axis=-1).astype(np.float32)
    intrinsics = np.tile(np.array([[7.5, 0, W / 2 + 1.25], [0, 300, H / 2 - 0.75], [0, 0, 1]]), (2, 1, 1))
    result = make_room(2, H, W, camera_from_world=poses, intrinsics=intrinsics.astype(np.float32))
    tolerance = 2e-6 * max(size, 1)
    export_result(result, tmp_path / "out.txt", form, exporting=Exporting(points=20))
    if form in ("tum", "kitti"):
        np.testing.assert_allclose(read_poses(tmp_path / "out.txt", result), result.world_from_camera, atol=tolerance)
        return
    capture: Any = read_capture(tmp_path / "out.txt")
    np.testing.assert_allclose(capture.intrinsics, result.intrinsics, rtol=1e-7, atol=1e-6)
    wanted = world_from_camera(np.stack([rigid(pose) for pose in poses]))
    np.testing.assert_allclose(capture.world_from_camera[:, :3, :3], wanted[:, :3, :3], atol=1e-6)
    np.testing.assert_allclose(capture.world_from_camera[:, :3, 3], wanted[:, :3, 3], atol=tolerance)


@pytest.fixture(scope="module")
def result():
    return make_room(FRAMES, H, W, frame_names=["frame_9", "frame_10", "frame_11", "frame_12"], timestamps=None)


@pytest.fixture(scope="module")
def results(tmp_path_factory, result):
    """A folder of results that holds the result of the sequence "out"."""
    folder = tmp_path_factory.mktemp("results")
    result.save(folder / "out")
    return folder


@pytest.mark.parametrize("form", ["colmap", "nerfstudio"])
def test_a_result_has_no_error_against_its_own_export(tmp_path, result, results, capsys, form):
    needed(form)
    export_result(result, tmp_path / "scenes/out", form, exporting=Exporting(points=300))
    capture: Any = read_capture(tmp_path / "scenes/out")
    assert capture.frame_names == result.frame_names
    scores = tmp_path / "scores"
    arguments = ["evaluate", "capture", str(tmp_path / "scenes"), "--out", str(scores), "--depth-align", "metric"]
    assert cli.main([*arguments, "--results", f"mine={results}"]) == 0, capsys.readouterr().out
    (record,) = json.loads((scores / "results.json").read_text())["sequences"]
    assert (record["name"], record["method"], record["status"]) == ("out", "mine", "ok")
    metrics = record["metrics"]
    assert max(metrics["ate"], metrics["rte"], metrics["rre"] / 100) < 1e-6
    assert any("not the metre" in note for note in record["notes"])
    if form == "nerfstudio":
        assert metrics["abs_rel"] < 1e-6
        assert metrics["distance_paired_mean"] < 1e-6
    else:
        assert "abs_rel" not in metrics
        assert any("it has no depth" in note for note in record["notes"])


def test_an_export_is_a_clip_of_the_result_s_frames(tmp_path, result):
    export_result(result, tmp_path / "out", "nerfstudio")
    clip = load_clip(tmp_path / "out", size=W, patch=14, start=1, max_frames=2)
    assert clip.frame_names == ["frame_10", "frame_11"]
    np.testing.assert_array_equal(np.rint(255 * clip.images), result.images[1:3])
    chosen: Any = read_capture(tmp_path / "out").for_frames(clip.frame_names)
    np.testing.assert_allclose(chosen.depth(1), np.where(result.valid_pixels[2], result.depth[2], 0), rtol=1e-6)
    for number, frame in enumerate(json.loads((tmp_path / "out/transforms.json").read_text())["frames"]):
        with Image.open(tmp_path / "out" / frame["mask_path"]) as mask:
            np.testing.assert_array_equal(np.asarray(mask) == 0, result.dynamic_mask[number])
