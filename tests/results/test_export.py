from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from tests.clips.captures.folders import make_truth, tum
from tests.shared.contents import contents
from tests.shared.room import make_room
from tests.shared.tiny import tiny_model
from vggtjax import load_clip
from vggtjax.errors import InputError, OutputError
from vggtjax.options import Options
from vggtjax.pipeline.fields import settings_of
from vggtjax.results import export
from vggtjax.results.frame import frame_of
from vggtjax.results.point_cloud import least_confidence
from vggtjax.results.reconstruction import Reconstruction
from vggtjax.results.saving import Saving
from vggtjax.storage.trajectories import associate, read_trajectory

pytestmark = pytest.mark.usefixtures("empty_reports")

FILES = {"reconstruction.npz", "trajectory.txt", "intrinsics.txt", "static.ply", "scene.glb", "report.html"}
FILES |= {"depth/scale.txt", "preview/sheet.png", "preview/card.webp"}
FRAME_FILES = ("confidence/{}.npy", "depth/{}.npy", "depth/{}.png", "mask/{}.png", "instances/{}.png")
FRAME_FILES += ("preview/depth/{}.png", "preview/overlay/{}.png", "frames/{}.ply")


def read_ply(path) -> trimesh.PointCloud:
    cloud = trimesh.load(path)
    assert isinstance(cloud, trimesh.PointCloud)
    return cloud


def expected_files(frames):
    return FILES | {name.format(f"{frame:06d}") for frame in range(frames) for name in FRAME_FILES}


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    folder = tmp_path_factory.mktemp("saved") / "new" / "result"
    make_room().save(folder)
    return folder


def test_files_of_cameras_and_depth(saved):
    assert set(contents(saved)) == expected_files(3)
    room = make_room()
    assert (saved / "intrinsics.txt").read_text().startswith("# fx fy cx cy in pixels of 42 x 28\n")
    np.testing.assert_allclose(np.loadtxt(saved / "intrinsics.txt"), [[37.8, 37.8, 21, 14]] * 3, rtol=1e-6)
    times, poses = read_trajectory(saved / "trajectory.txt")
    np.testing.assert_allclose(times, np.asarray(room.timestamps), atol=1e-6)
    np.testing.assert_allclose(poses, room.world_from_camera, atol=1e-5)
    scale = float(np.loadtxt(saved / "depth/scale.txt"))
    assert scale == pytest.approx(65535 / room.depth.max())
    for frame, depth in enumerate(room.depth):
        np.testing.assert_array_equal(np.load(saved / f"depth/{frame:06d}.npy", allow_pickle=False), depth)
        with Image.open(saved / f"depth/{frame:06d}.png") as picture:
            assert picture.mode == "I;16"
            assert float(picture.info["depth_scale"]) == scale
            np.testing.assert_allclose(np.asarray(picture) / scale, depth, atol=0.5 / scale + 1e-6)


def test_encoded_depth_by_hand():
    depth = np.array([[[1, 2, 1e-9, np.inf, np.nan, 0.5]]], np.float32)
    valid = np.isfinite(depth) & (depth != 0.5)
    scale = export.depth_scale(depth, valid)
    assert scale == 65535 / 2
    np.testing.assert_array_equal(export.encode_depth(depth[0], valid[0], scale), [[32768, 65535, 1, 0, 0, 0]])
    assert export.depth_scale(depth, depth < 0) == 1


def test_masks_and_previews(saved):
    for frame, mask in enumerate(make_room().dynamic_mask):
        with Image.open(saved / f"mask/{frame:06d}.png") as picture:
            np.testing.assert_array_equal(np.asarray(picture), mask * 255)
        with Image.open(saved / f"instances/{frame:06d}.png") as picture:
            assert picture.mode == "P"
            np.testing.assert_array_equal(np.asarray(picture), make_room().instances[frame])
        for name in ("depth", "overlay"):
            with Image.open(saved / f"preview/{name}/{frame:06d}.png") as picture:
                assert (picture.mode, picture.size) == ("RGB", (12 * 42, 12 * 28))  # the data keep their size


def test_clouds(saved):
    room = make_room()
    pixels = confident(room, 20)
    static = read_ply(saved / "static.ply")
    assert len(static.vertices) == (pixels & ~room.dynamic_mask).sum()
    for frame in range(3):
        cloud = read_ply(saved / f"frames/{frame:06d}.ply")
        np.testing.assert_array_equal(cloud.colors[:, :3], room.images[frame][pixels[frame]])
        expected = room.world_points()[frame][pixels[frame]]
        np.testing.assert_allclose(cloud.vertices, expected, rtol=1e-5, atol=1e-6)


def test_original_resolution(tmp_path):
    room = make_room()  # its source has twice as many pixels a side
    pictures = [np.full((56, 84, 3), 50 * frame, np.uint8) for frame in range(3)]
    room.save(tmp_path, resolution="original", pictures=iter(pictures), confidence_percentile=0)
    assert set(contents(tmp_path)) == expected_files(3)
    for frame in range(3):
        expected = frame_of(room, frame, "original", picture=pictures[frame])
        np.testing.assert_array_equal(np.load(tmp_path / f"depth/{frame:06d}.npy"), expected.depth)
        with Image.open(tmp_path / f"mask/{frame:06d}.png") as picture:
            np.testing.assert_array_equal(np.asarray(picture) > 0, expected.dynamic_mask)
        with Image.open(tmp_path / f"preview/overlay/{frame:06d}.png") as picture:
            assert picture.size == (6 * 84, 6 * 56)
        cloud = read_ply(tmp_path / f"frames/{frame:06d}.ply")
        np.testing.assert_allclose(cloud.vertices, expected.world_points().reshape(-1, 3), rtol=1e-5, atol=1e-6)
        assert (cloud.colors[:, :3] == 50 * frame).all()
    assert (tmp_path / "intrinsics.txt").read_text().startswith("# fx fy cx cy in pixels of 84 x 56\n")
    np.testing.assert_allclose(np.loadtxt(tmp_path / "intrinsics.txt"), [[75.6, 75.6, 42, 28]] * 3, rtol=1e-6)
    static = sum(frame_of(room, frame, "original").valid.sum() for frame in range(3)) - 4 * room.dynamic_mask.sum()
    assert len(read_ply(tmp_path / "static.ply").vertices) == static
    np.testing.assert_array_equal(Reconstruction.load(tmp_path).depth, room.depth)


def test_pictures_that_do_not_fit(tmp_path):
    picture, options = np.zeros((56, 84, 3), np.uint8), {"resolution": "original"}
    mixed = {"source_size": [[56, 84], [84, 56], [56, 84]]}
    cases: Any = (
        ({}, options | {"pictures": [picture] * 2}, "there are 2 pictures for 3 frames"),
        ({}, options | {"pictures": [picture] * 4}, "there are more pictures than the 3 frames"),
        ({}, options | {"pictures": [picture[1:]] * 3}, r"the picture of frame 0 is .*; expected uint8 \(56, 84, 3\)"),
        (mixed, options | {"format": "vggt4d"}, "have 2 sizes; the format vggt4d expects one"),
    )
    for changes, given, words in cases:
        with pytest.raises(InputError, match=words):
            make_room(**changes).save(tmp_path, **given)
    assert not any(contents(tmp_path))


def test_format_of_vggt4d(tmp_path):
    room = make_room()
    room.save(tmp_path, saving=Saving(format="vggt4d", resolution="original"))
    names = ("frame_{}.png", "frame_{}.npy", "conf_{}.npy", "dynamic_mask_{}.png")
    theirs = {f"vggt4d/{name.format(f'{frame:04d}')}" for frame in range(3) for name in names}
    theirs |= {"vggt4d/pred_intrinsics.txt", "vggt4d/pred_traj.txt"}
    assert set(contents(tmp_path)) == expected_files(3) | theirs
    frame = frame_of(room, 2, "original")
    np.testing.assert_array_equal(np.load(tmp_path / "vggt4d/frame_0002.npy"), frame.depth)
    np.testing.assert_array_equal(np.load(tmp_path / "vggt4d/conf_0002.npy"), frame.confidence)
    assert np.loadtxt(tmp_path / "vggt4d/pred_traj.txt")[1, 4] == pytest.approx(1)  # qw of the pose without a turn
    again = Reconstruction.load(tmp_path / "vggt4d", format="vggt4d", quaternion="wxyz")
    np.testing.assert_allclose(again.camera_from_world, room.camera_from_world, atol=1e-6)
    np.testing.assert_allclose(again.intrinsics[2], frame.intrinsics, rtol=1e-6)
    np.testing.assert_array_equal(again.images[2], frame.image)
    np.testing.assert_array_equal(again.dynamic_mask[2], frame.dynamic_mask)
    room.save(tmp_path)
    assert set(contents(tmp_path)) == expected_files(3)  # the folder was part of the earlier result
    (tmp_path / "vggt4d").mkdir()
    (tmp_path / "vggt4d/frame_0000.npy").write_text("mine")
    with pytest.raises(OutputError, match="vggt4d exists and is not part of an earlier result"):
        room.save(tmp_path, format="vggt4d")


@pytest.mark.parametrize(
    ("changes", "static", "moving"),
    [({"dynamic_mask": np.ones((3, 28, 42), bool)}, False, True), ({"depth": np.zeros((3, 28, 42))}, False, False)],
)
def test_everything_moves_or_has_no_depth(tmp_path, changes, static, moving):
    room = make_room(**changes)
    room.save(tmp_path)
    assert set(contents(tmp_path)) == expected_files(3)
    assert (b"element vertex 0\n" in (tmp_path / "static.ply").read_bytes()) == (not static)
    names = set(trimesh.load_scene(tmp_path / "scene.glb").geometry)
    assert ("static" in names, "dynamic_000002" in names, "cameras" in names) == (static, moving, True)


def test_padding_and_infinite_depth_never_become_points(tmp_path):
    depth = make_room().depth.copy()
    depth[0, 10, 10] = np.inf
    room = make_room(depth=depth, valid_box=np.tile([3, 2, 40, 26], (3, 1)))
    calls = []
    room.save(tmp_path, confidence_percentile=0, progress=lambda done, total: calls.append((done, total)))
    assert calls == [(done, 8) for done in range(1, 9)]
    assert len(read_ply(tmp_path / "frames/000000.ply").vertices) == 37 * 24 - 1
    assert len(read_ply(tmp_path / "frames/000001.ply").vertices) == 37 * 24
    with Image.open(tmp_path / "depth/000000.png") as picture:
        encoded = np.asarray(picture)
    assert encoded[10, 10] == encoded[0, 0] == 0
    assert (encoded > 0).sum() == 37 * 24 - 1


def confident(room, percentile):
    least = least_confidence(room, percentile)
    return np.stack([frame_of(room, number).confident(least) for number in range(len(room.depth))])


def test_percentile_is_taken_over_the_clip_and_ties_stay():
    confidence = np.ones((2, 14, 14), np.float32)
    confidence[0, 0, :4] = (0.1, 0.2, 0.3, 0.4)
    room = make_room(2, 14, 14, depth_confidence=confidence, dynamic_mask=np.zeros((2, 14, 14), bool))
    kept = confident(room, 100 * 2 / 391)  # the third lowest of 392
    assert (~kept).sum() == 2
    assert not kept[0, 0, :2].any()
    assert confident(room, 0).all()
    assert confident(room, 50).sum() == 388  # all the ones tie with the median


def test_what_moves_has_a_percentile_of_its_own():
    """One pass vouches for it, two for what stands still: a common percentile would remove it."""
    moving = np.zeros((2, 14, 14), bool)
    moving[:, :5] = True
    confidence = np.where(moving, 1, 2) + np.linspace(0, 0.5, moving.size, dtype=np.float32).reshape(moving.shape)
    kept = confident(make_room(2, 14, 14, depth_confidence=confidence.astype(np.float32), dynamic_mask=moving), 20)
    assert [round(float(kept[pixels].mean()), 2) for pixels in (moving, ~moving)] == [0.8, 0.8]


NAMES = ("1305031102.175304", "1305031102.211214", "1305031102.3")


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"timestamps": np.array([0, 0.035, 0.125]), "settings": {"first_time": 1305031102.175304}}, 1305031102.175304),
        ({"timestamps": np.array([0, 0.035, 0.125]), "settings": {"first_time": 12}}, 12),
        ({"timestamps": np.array([0, 0.035, 0.125])}, 0),
        ({"timestamps": None, "frame_names": NAMES}, [float(name) for name in NAMES]),
        ({"timestamps": np.array([0, 0.035, 0.125]), "frame_names": NAMES}, [float(name) for name in NAMES]),
        ({"timestamps": None, "frame_names": ("v1.2", "v1.3", "v1.4")}, [0, 1, 2]),
        ({"timestamps": None, "frame_names": ("7", "8", "9")}, [0, 1, 2]),
    ],
)
def test_files_have_the_times_of_the_source(tmp_path, changes, expected):
    room = make_room(**changes)
    start = [0] * 3 if isinstance(expected, list) else [0, 0.035, 0.125]
    np.testing.assert_allclose(room.file_times, np.add(expected, start), atol=1e-6, rtol=0)
    room.save(tmp_path / "out", only=("cameras",))
    times, _ = read_trajectory(tmp_path / "out/trajectory.txt")
    np.testing.assert_allclose(times, room.file_times, atol=2e-6, rtol=0)


@pytest.mark.parametrize("named", [True, False])
def test_a_capture_tells_its_clock(tmp_path, named):
    folder = tum(tmp_path / "scene", make_truth(shared=True))
    if not named:  # files that are not named after their times
        text = (folder / "rgb.txt").read_text()
        for number, path in enumerate(sorted((folder / "rgb").iterdir())):
            text = text.replace(f"rgb/{path.name}", f"rgb/{number}.png")
            path.rename(folder / f"rgb/{number}.png")
        (folder / "rgb.txt").write_text(text)
    clip = load_clip(folder, size=28)
    np.testing.assert_allclose(clip.timestamps, [0, 0.1, 0.2, 0.3], atol=1e-9)  # type: ignore[arg-type]
    settings = settings_of(tiny_model(), clip, Options(), "cues", None)
    assert settings["first_time"] == 100


def test_files_have_nanoseconds_that_no_float_holds(tmp_path):
    names = [f"frame_{time}" for time in ("1403636579763555584", "1403636579813555457", "1403636579863555586")]
    for name in names:
        Image.new("RGB", (28, 28)).save(tmp_path / f"{name}.png")
    clip = load_clip(tmp_path, size=28)
    settings = settings_of(tiny_model(), clip, Options(), "cues", None)
    room = make_room(3, timestamps=clip.timestamps, frame_names=tuple(clip.frame_names), settings=settings)
    assert room.known_facts["times"] == "from the names of the frames, in nanoseconds"
    room.save(tmp_path / "out", only=("cameras",))
    written = Reconstruction.load(tmp_path / "out")
    for folder in (tmp_path / "out", tmp_path / "again"):
        written.save(folder, only=("cameras",))
        lines = (folder / "trajectory.txt").read_text().splitlines()[1:]
        fractions = ("579.763555584", "579.813555457", "579.863555586")
        assert [line.split()[0] for line in lines] == [f"1403636{fraction}" for fraction in fractions]
    assert len(associate(room.file_times, np.array([1403636579.7635, 1403636579.8635]))) == 2
