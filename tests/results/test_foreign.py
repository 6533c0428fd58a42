import logging

import numpy as np
import pytest

from tests.results import foreign_writers as writers
from tests.results.foreign_writers import QUATERNIONS, ROOM, WITH_MASKS, WRITERS
from vggtjax.errors import InputError, ResultError
from vggtjax.results.reconstruction import Reconstruction


@pytest.mark.parametrize("layout", WRITERS)
def test_everything_comes_back(tmp_path, layout):
    WRITERS[layout](tmp_path / "theirs")
    result = Reconstruction.load(tmp_path / "theirs", format=layout, quaternion=QUATERNIONS[layout])
    np.testing.assert_array_equal(result.depth, ROOM.depth)
    np.testing.assert_allclose(result.depth_confidence, ROOM.depth_confidence, rtol=1e-6)
    np.testing.assert_allclose(result.camera_from_world, ROOM.camera_from_world, atol=1e-6)
    np.testing.assert_allclose(result.intrinsics, ROOM.intrinsics, rtol=1e-6)
    np.testing.assert_array_equal(result.images, ROOM.images)
    np.testing.assert_allclose(result.world_points(), ROOM.world_points(), atol=1e-4)
    masks = layout in WITH_MASKS
    np.testing.assert_array_equal(result.dynamic_mask, ROOM.dynamic_mask & masks)
    assert result.settings["missing"] == ([] if masks else ["dynamic_mask"])
    assert (result.saliency, result.method) == (None, layout)
    result.save(tmp_path / "ours", only=("cameras",))
    np.testing.assert_array_equal(Reconstruction.load(tmp_path / "ours").depth, ROOM.depth)


def test_what_das3r_trains_on(tmp_path):
    writers.rearrange(tmp_path / "x")
    result = Reconstruction.load(tmp_path / "x", format="das3r", quaternion="wxyz")
    np.testing.assert_array_equal(result.depth, ROOM.depth)
    np.testing.assert_allclose(result.depth_confidence, ROOM.depth_confidence, rtol=1e-6)
    np.testing.assert_array_equal(result.dynamic_mask, ROOM.dynamic_mask)
    np.testing.assert_array_equal(result.images, ROOM.images)


def test_the_file_of_spatialtracker_is_found_and_two_are_refused(tmp_path):
    writers.write_spatialtracker(tmp_path / "results", "walk_result.npz")
    for path in (tmp_path, tmp_path / "results", tmp_path / "results/walk_result.npz"):
        np.testing.assert_array_equal(Reconstruction.load(path, format="spatialtrackerv2").depth, ROOM.depth)
    writers.write_spatialtracker(tmp_path / "results", "run_result.npz")
    with pytest.raises(ResultError, match=r"run_result\.npz and walk_result\.npz may both be the result"):
        Reconstruction.load(tmp_path / "results", format="spatialtrackerv2")


def test_small_files_of_da3(tmp_path, caplog):
    writers.write_da3(tmp_path, "mini_npz", rows=4)
    with caplog.at_level(logging.WARNING):
        result = Reconstruction.load(tmp_path, format="da3")
    np.testing.assert_allclose(result.camera_from_world, ROOM.camera_from_world)
    assert (result.images == 128).all()
    assert "has no dynamic_mask, images; plain values stand for them" in caplog.text
    again = Reconstruction.load(tmp_path / "exports/mini_npz/results.npz", format="da3")
    np.testing.assert_array_equal(again.depth, result.depth)


def test_the_order_of_quaternions_must_be_said_and_matters(tmp_path):
    WRITERS["vggt4d"](tmp_path / "x")
    with pytest.raises(InputError, match="does not say the order of its quaternions; give quaternion 'wxyz'"):
        Reconstruction.load(tmp_path / "x", format="vggt4d")
    wrong = Reconstruction.load(tmp_path / "x", format="vggt4d", quaternion="xyzw")
    assert np.abs(wrong.camera_from_world - ROOM.camera_from_world).max() > 0.1


def without(names):
    return lambda folder: [path.unlink() for path in folder.glob(names)]


def rename(name, other):
    return lambda folder: (folder / name).rename(folder / other)


def write(name, content):
    return lambda folder: (folder / name).write_bytes(content)


def save(name, array):
    return lambda folder: np.save(folder / name, array, allow_pickle=True)


def changed(name, **changes):
    """Write an .npz file again with some of its arrays replaced or (None) removed."""

    def change(folder):
        arrays = {key: array for key, array in np.load(folder / name).items() if key != "allow_pickle"} | changes
        np.savez(folder / name, **{key: array for key, array in arrays.items() if array is not None})

    return change


CAMERA, DA3, TRACKED = "camera/000001.npz", "exports/npz/results.npz", "clip_result.npz"
SHAPES = r"'extrinsics' of results.npz is float64 \(1, 3, 4\); expected floating point \(3, 3, 4\)"


@pytest.mark.parametrize(
    ("layout", "change", "message"),
    [
        ("vggt4d", write("frame_0002.npy", b"\x93NUMPY\x01\x00"), r"frame_0002\.npy has an invalid header"),
        ("vggt4d", save("frame_0002.npy", np.array([{}, 1], object)), "holds Python objects"),
        ("vggt4d", save("frame_0002.npy", np.ones((28, 41), np.float32)), r"has shape \(28, 41\); expected \(28, 42\)"),
        ("vggt4d", save("conf_0002.npy", np.ones((28, 42), int)), r"conf_0002\.npy is int64 .*; expected float"),
        ("vggt4d", save("frame_2.npy", np.ones((28, 42), np.float32)), "are both of frame 2"),
        ("monst3r", rename("conf_0.npy", "conf_0000.npy"), r"conf_0000\.npy is numbered as VGGT4D does"),
        ("cut3r", changed(CAMERA, pose=2 * np.eye(4)), "camera_from_world of frame 1 is not a finite rotation"),
        ("cut3r", without(CAMERA), r"frame 1 has depth, but no camera/000001\.npz"),
        ("da3", changed(DA3, image=np.ones((3, 28, 42, 3), np.uint16)), "'image' of .* is uint16 .* expected uint8"),
        ("da3", changed(DA3, extrinsics=np.ones((1, 3, 4))), SHAPES),
        ("easi3r", without("conf_1.npy"), r"frame 1 has depth, but no file like conf_0\.npy"),
        ("das3r", without("frame_*.npy"), "frame_0000.npy or depth_maps"),
        ("spatialtrackerv2", changed(TRACKED, depths=None), "'depths' of clip_result.npz is missing"),
        ("spatialtrackerv2", changed(TRACKED, video=ROOM.images), r"'video' of .* is uint8 .* expected floating point"),
        ("spatialtrackerv2", without(TRACKED), "it has no result.npz; inference.py writes it"),
    ],
)
def test_what_is_broken_is_named(tmp_path, layout, change, message):
    WRITERS[layout](tmp_path / "x")
    change(tmp_path / "x")
    with pytest.raises(ResultError, match=message) as raised:
        Reconstruction.load(tmp_path / "x", format=layout, quaternion=QUATERNIONS[layout])
    assert str(raised.value).startswith(f"{tmp_path / 'x'} cannot be loaded as a result of {layout}: ")


def test_numbers_of_files_and_of_poses_tell_which_frames_have_both(tmp_path, caplog):
    tmp_path = tmp_path / "result"
    WRITERS["vggt4d"](tmp_path)
    (tmp_path / "frame_0001.npy").unlink()  # depth of keyframes, poses of all frames
    result = Reconstruction.load(tmp_path, format="vggt4d", quaternion="wxyz")
    assert result.frame_names == ("000000", "000002")
    np.testing.assert_allclose(result.camera_from_world, ROOM.camera_from_world[[0, 2]], atol=1e-6)
    np.testing.assert_array_equal(result.depth, ROOM.depth[[0, 2]])
    np.testing.assert_array_equal(result.dynamic_mask, ROOM.dynamic_mask[[0, 2]])

    np.save(tmp_path / "frame_0001.npy", ROOM.depth[1])  # depth of all frames, poses of keyframes
    for name in ("pred_traj.txt", "pred_intrinsics.txt"):
        lines = (tmp_path / name).read_text().splitlines()
        (tmp_path / name).write_text("\n".join([lines[0], lines[2]]))
    result = Reconstruction.load(tmp_path, format="vggt4d", quaternion="wxyz")
    assert result.frame_names == ("000000", "000002")
    np.testing.assert_allclose(result.camera_from_world, ROOM.camera_from_world[[0, 2]], atol=1e-6)
    assert "has cameras for 2 of 3 frames of depth" in caplog.text
    assert result.settings["lost"] == [1]


def test_a_camera_that_is_not_finite_leaves_its_frame_out(tmp_path, caplog):
    tmp_path = tmp_path / "result"
    WRITERS["monst3r"](tmp_path)
    lines = (tmp_path / "pred_traj.txt").read_text().splitlines()
    (tmp_path / "pred_traj.txt").write_text("\n".join([lines[0], "1 " + "nan " * 7, lines[2]]))
    result = Reconstruction.load(tmp_path, format="monst3r", quaternion="wxyz")
    assert result.frame_names == ("000000", "000002")
    np.testing.assert_array_equal(result.depth, ROOM.depth[[0, 2]])
    assert "no finite camera for 1 of 3 frames, 000001 first" in caplog.text
    assert result.settings["lost"] == [1]
