import json
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.shared.dataset_files import opened
from tests.shared.room import make_room
from vggtjax.clips.captures.table import read_capture
from vggtjax.results.exports.table import Exporting
from vggtjax.results.exports.write import export_result

FRAMES, H, W = 10, 28, 42


@pytest.fixture(scope="module")
def room():
    random = np.random.default_rng(0)
    turns, places = Rotation.random(FRAMES, rng=random).as_matrix(), random.normal(size=(FRAMES, 3, 1))
    poses = np.concatenate([turns, places], axis=-1).astype(np.float32)
    intrinsics = np.tile(np.array([[37, 0, 24], [0, 31, 12], [0, 0, 1]], np.float32), (FRAMES, 1, 1))
    times = 3 + np.array([0, 1, 2, 3, 5, 6, 7, 8, 9, 10.0])
    box = np.tile([2, 0, W, H], (FRAMES, 1))
    changes = {"intrinsics": intrinsics, "timestamps": times, "valid_box": box}
    return make_room(FRAMES, H, W, camera_from_world=poses, **changes)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, room):
    folder = tmp_path_factory.mktemp("splats") / "scene"
    export_result(room, folder, "dynamic-splats", exporting=Exporting(points=300))
    return folder


def read(folder, name) -> Any:
    return json.loads((folder / name).read_text())


def test_dycheck_s_reader_finds_the_cameras_and_the_depth(folder, room):
    (sequence,) = opened("dycheck", folder, gt="lidar", stride=1)
    trained = [number for number in range(FRAMES) if number != 4]
    assert [path.stem for path in sequence.pictures] == [f"0_{number:05d}" for number in trained]
    np.testing.assert_allclose(sequence.world_from_camera, room.world_from_camera[trained], atol=1e-5)
    np.testing.assert_allclose(sequence.intrinsics, room.intrinsics[trained], atol=1e-5)
    for place, number in enumerate(trained):
        expected = np.where(room.valid_pixels[number], room.depth[number], 0)
        np.testing.assert_array_equal(sequence.depth(place), expected)
    assert sequence.notes[1:] == ("scene: its ground truth is lidar",)


def test_nerfstudio_s_reader_finds_all_cameras(folder, room):
    capture: Any = read_capture(folder)
    np.testing.assert_allclose(capture.world_from_camera, room.world_from_camera, atol=1e-5)
    np.testing.assert_allclose(capture.intrinsics, room.intrinsics, atol=1e-5)
    frames = read(folder, "transforms.json")["frames"]
    assert [frame["time"] for frame in frames] == pytest.approx([0, 0.1, 0.2, 0.3, 0.5, 0.6, 0.7, 0.8, 0.9, 1])


def test_splits_times_and_scene(folder, room):
    facts, metadata = read(folder, "dataset.json"), read(folder, "metadata.json")
    assert facts["val_ids"] == read(folder, "splits/val.json")["frame_names"] == ["0_00004"]
    assert read(folder, "splits/val.json")["time_ids"] == [4]
    assert sorted(facts["train_ids"] + facts["val_ids"]) == facts["ids"] == list(metadata)
    assert read(folder, "transforms.json")["test_filenames"] == ["rgb/1x/0_00004.png"]
    assert [metadata[name]["warp_id"] for name in facts["ids"]] == list(range(FRAMES))
    assert metadata["0_00004"]["time"] == pytest.approx(0.5)
    scene, extra = read(folder, "scene.json"), read(folder, "extra.json")
    assert extra["fps"] == pytest.approx(1)
    low, high = np.array(extra["bbox"])
    assert np.linalg.norm(high - low) == pytest.approx(1)
    centres = (room.camera_centres - scene["center"]) * scene["scale"]
    assert ((centres >= low - 1e-6) & (centres <= high + 1e-6)).all()
    depth = room.depth[room.valid_pixels] * scene["scale"]
    assert 0.7 * depth.min() < scene["near"] < depth.min() < depth.max() < scene["far"] < 1.3 * depth.max()


def test_pictures_masks_and_points(folder, room):
    for number in (0, 4):
        name = f"0_{number:05d}"
        with Image.open(folder / f"rgb/1x/{name}.png") as picture:
            pixels = np.asarray(picture)
        np.testing.assert_array_equal(pixels[..., :3], room.images[number])
        np.testing.assert_array_equal(pixels[..., 3] > 0, np.broadcast_to(np.arange(W) >= 2, (H, W)))
        with Image.open(folder / f"rgb/2x/{name}.png") as half:
            assert half.size == (W // 2, H // 2)
        with Image.open(folder / f"mask/1x/{name}.png") as mask:
            np.testing.assert_array_equal(np.asarray(mask) > 0, room.dynamic_mask[number])
        moving = trimesh.load(folder / f"moving/{name}.ply")
        assert isinstance(moving, trimesh.PointCloud)
        assert (moving.colors[:, 0] == 220).all()
    points = np.load(folder / "points.npy", allow_pickle=False)
    assert 100 < len(points) <= 300
    static = trimesh.load(folder / "points3D_downsample2.ply")
    assert isinstance(static, trimesh.PointCloud)
    np.testing.assert_allclose(static.vertices, points, atol=1e-6)
    assert (static.colors[:, 0] <= 100).all()


@pytest.mark.parametrize(("frames", "tested"), [(1, []), (2, []), (3, ["0_00001"]), (20, ["0_00004", "0_00012"])])
def test_short_and_long_clips(tmp_path, frames, tested):
    export_result(make_room(frames, timestamps=None), tmp_path / "out", "dynamic-splats")
    facts = read(tmp_path / "out", "dataset.json")
    assert facts["val_ids"] == tested
    assert facts["num_exemplars"] == frames - len(tested)
    assert [frame["time"] for frame in read(tmp_path / "out", "transforms.json")["frames"]][-1] == min(frames - 1, 1)
