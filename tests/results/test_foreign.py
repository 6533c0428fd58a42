"""Result folders of other projects, written here as their public code writes them."""

import logging

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.room import make_room
from vggtjax.errors import InputError, ResultError
from vggtjax.reconstruction import Reconstruction

ROOM = make_room(3)


def write_flat(folder, padded, logarithmic):
    """VGGT4D's `process_scene` pads all numbers, MonST3R's `save_*` those of frame_ alone; quaternions have w first."""
    folder.mkdir()
    poses = ROOM.world_from_camera.astype(float)
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=True)
    with (folder / "pred_traj.txt").open("w") as file:
        for number, (pose, turn) in enumerate(zip(poses, quaternions, strict=True)):
            file.write(" ".join(str(value) for value in (float(number), *pose[:3, 3], *turn)) + "\n")
    np.savetxt(folder / "pred_intrinsics.txt", ROOM.intrinsics.reshape(-1, 9), fmt="%.6f")
    for number in range(3):
        short = f"{number:04d}" if padded else str(number)
        Image.fromarray(ROOM.images[number]).save(folder / f"frame_{number:04d}.png")
        np.save(folder / f"frame_{number:04d}.npy", ROOM.depth[number])
        confidence = ROOM.depth_confidence[number]
        np.save(folder / f"conf_{short}.npy", np.log(confidence) if logarithmic else confidence)
        Image.fromarray(255 * ROOM.dynamic_mask[number].astype(np.uint8)).save(folder / f"dynamic_mask_{short}.png")
        Image.fromarray(np.full((28, 42), 255, np.uint8)).save(folder / f"enlarged_dynamic_mask_{short}.png")
    Image.fromarray(np.zeros((9, 9), np.uint8)).save(folder / "dynamic_mask_bw.png")  # of MonST3R's pair viewer


def write_cut3r(folder):
    """CUT3R's `prepare_output`."""
    for name in ("depth", "conf", "color", "camera"):
        (folder / name).mkdir(parents=True)
    for number in range(3):
        np.save(folder / f"depth/{number:06d}.npy", ROOM.depth[number])
        np.save(folder / f"conf/{number:06d}.npy", ROOM.depth_confidence[number])
        Image.fromarray(ROOM.images[number]).save(folder / f"color/{number:06d}.png")
        pose, intrinsics = ROOM.world_from_camera[number], ROOM.intrinsics[number]
        np.savez(folder / f"camera/{number:06d}.npz", pose=pose, intrinsics=intrinsics)


def write_da3(folder, kind="npz", rows=3):
    """Depth Anything 3's exporters npz and mini_npz: camera-from-world, with a last row or without."""
    poses = np.tile(np.eye(4, dtype=np.float32), (3, 1, 1))
    poses[:, :3] = ROOM.camera_from_world
    arrays = {
        "depth": ROOM.depth,
        "conf": ROOM.depth_confidence,
        "extrinsics": poses[:, :rows],
        "intrinsics": ROOM.intrinsics,
    }
    (folder / "exports" / kind).mkdir(parents=True)
    if kind == "npz":
        arrays["image"] = ROOM.images
    np.savez_compressed(folder / "exports" / kind / "results.npz", allow_pickle=True, **arrays)


WRITERS = {
    "vggt4d": lambda folder: write_flat(folder, padded=True, logarithmic=False),
    "monst3r": lambda folder: write_flat(folder, padded=False, logarithmic=True),
    "cut3r": write_cut3r,
    "da3": write_da3,
}
QUATERNIONS = {"vggt4d": "wxyz", "monst3r": "wxyz", "cut3r": None, "da3": None}


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
    masks = layout in ("vggt4d", "monst3r")
    np.testing.assert_array_equal(result.dynamic_mask, ROOM.dynamic_mask & masks)
    assert result.settings["missing"] == ([] if masks else ["dynamic_mask"])
    assert (result.saliency, result.method) == (None, layout)
    result.save(tmp_path / "ours", only=("cameras",))
    np.testing.assert_array_equal(Reconstruction.load(tmp_path / "ours").depth, ROOM.depth)


def test_small_files_of_da3(tmp_path, caplog):
    write_da3(tmp_path, "mini_npz", rows=4)
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


def remove(name):
    return lambda folder: (folder / name).unlink()


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


CAMERA, DA3 = "camera/000001.npz", "exports/npz/results.npz"
SHAPES = r"'extrinsics' of results.npz is float64 \(1, 3, 4\); expected floating point \(3, 3, 4\)"


@pytest.mark.parametrize(
    ("layout", "change", "message"),
    [
        ("vggt4d", write("frame_0002.npy", b"\x93NUMPY\x01\x00"), r"frame_0002\.npy has an invalid header"),
        ("vggt4d", save("frame_0002.npy", np.array([{}, 1], object)), "holds Python objects"),
        ("vggt4d", save("frame_0002.npy", np.ones((28, 41), np.float32)), r"has shape \(28, 41\); expected \(28, 42\)"),
        (
            "vggt4d",
            save("conf_0002.npy", np.ones((28, 42), int)),
            r"conf_0002\.npy is int64 .*; expected float",
        ),
        ("vggt4d", save("frame_2.npy", np.ones((28, 42), np.float32)), "are both of frame 2"),
        ("monst3r", rename("conf_0.npy", "conf_0000.npy"), r"conf_0000\.npy is numbered as VGGT4D does"),
        ("cut3r", changed(CAMERA, pose=2 * np.eye(4)), "camera_from_world of frame 1 is not a finite rotation"),
        ("cut3r", remove(CAMERA), r"frame 1 has depth, but no camera/000001\.npz"),
        ("da3", changed(DA3, image=np.ones((3, 28, 42, 3), np.uint16)), "'image' of .* is uint16 .* expected uint8"),
        ("da3", changed(DA3, extrinsics=np.ones((1, 3, 4))), SHAPES),
    ],
)
def test_what_is_broken_is_named(tmp_path, layout, change, message):
    WRITERS[layout](tmp_path / "x")
    change(tmp_path / "x")
    with pytest.raises(ResultError, match=message) as raised:
        Reconstruction.load(tmp_path / "x", format=layout, quaternion=QUATERNIONS[layout])
    assert str(raised.value).startswith(f"{tmp_path / 'x'} cannot be loaded as a result of {layout}: ")
    assert "\n" not in str(raised.value)
