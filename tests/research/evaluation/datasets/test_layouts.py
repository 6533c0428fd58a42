import struct

import numpy as np
import pytest

from tests.shared.dataset_files import QUARTER_ABOUT_Y, SINTEL_TAG, cam, depth_png, dpt, opened, picture, write
from vggtjax.errors import InputError

SINTEL_K = [[1120.0, 0, 511.5], [0, 1120.0, 217.5], [0, 0, 1]]


def sintel_folder(root, frames=3, name="alley_2"):
    """MPI Sintel: training/final/<sequence>/frame_%04d.png, and depth/ and camdata_left/ of the depth training data."""
    training = root / "training"
    for i in range(1, frames + 1):
        frame = f"frame_{i:04d}"
        write(training / "final" / name / f"{frame}.png", picture())
        write(training / "depth" / name / f"{frame}.dpt", dpt(np.arange(12).reshape(3, 4) + i))
        extrinsics = np.column_stack([QUARTER_ABOUT_Y, [i, 2, 3]])
        write(training / "camdata_left" / name / f"{frame}.cam", cam(SINTEL_K, extrinsics))
    return training


def test_sintel(tmp_path):
    training = sintel_folder(tmp_path)
    assert [sequence.name for sequence in opened("sintel", training)] == ["alley_2"]
    values = [[np.nan, np.inf, -np.inf, -1], [0, 1, 2, 3], [4, 5, 6, 1e9]]
    write(training / "depth" / "alley_2" / "frame_0001.dpt", dpt(values))
    (sequence,) = opened("sintel", tmp_path)
    assert np.allclose(sequence.depth(0), [[0, 0, 0, 0], [0, 1, 2, 3], [4, 5, 6, 1e9]])  # what is not known is 0
    assert sequence.name == "alley_2"
    assert [path.name for path in sequence.pictures] == ["frame_0001.png", "frame_0002.png", "frame_0003.png"]
    assert np.array_equal(sequence.depth(1), np.arange(12).reshape(3, 4) + 2)
    assert np.array_equal(sequence.intrinsics[0], [[1120, 0, 512], [0, 1120, 218], [0, 0, 1]])  # the middle
    # x_cam = R X + t: R is a quarter turn, so the centre -R^T t of t = (2, 2, 3) is (3, -2, -2)
    assert np.allclose(sequence.world_from_camera[1], [[0, 0, -1, 3], [0, 1, 0, -2], [1, 0, 0, -2], [0, 0, 0, 1]])


DRIVE = "2011_09_26_drive_0002_sync"


def kitti_folder(root, pictures, depths):
    """KITTI depth: 16-bit PNG, 256 is a metre, 0 unknown (readme of the depth benchmark); raw data: calib_cam_to_cam
    with P_rect_02 as 12 numbers, and <date>/<drive>/image_02/data (readme of the raw data)."""
    for i in pictures:
        write(root / "2011_09_26" / DRIVE / "image_02" / "data" / f"{i:010d}.png", picture())
    for i in depths:
        content = depth_png([[0, 256, 128, 257 + i]] * 3)
        write(root / "val" / DRIVE / "proj_depth" / "groundtruth" / "image_02" / f"{i:010d}.png", content)
    lines = ["calib_time: 09-Jan-2012 13:57:47", "P_rect_00: " + "1 " * 12]
    lines += ["P_rect_02: 7.2e+02 0.0 6.1e+02 4.4e+01 0.0 7.3e+02 1.7e+02 2.1e-01 0.0 0.0 1.0 2.7e-03"]
    write(root / "2011_09_26" / "calib_cam_to_cam.txt", "\n".join(lines))


def test_kitti(tmp_path):
    kitti_folder(tmp_path, range(8), range(2, 7))
    (sequence,) = opened("kitti", tmp_path)
    assert sequence.name == DRIVE
    assert [int(path.stem) for path in sequence.pictures] == [2, 3, 4, 5, 6]
    assert np.allclose(sequence.depth(4), [[0, 1, 0.5, 263 / 256]] * 3)
    assert np.array_equal(sequence.intrinsics[0], [[720, 0, 610.5], [0, 730, 170.5], [0, 0, 1]])
    assert sequence.world_from_camera is None
    assert sequence.notes[1:] == (f"{DRIVE}: it has no poses",)


def test_kitti_gathered(tmp_path):
    for kind, content in (("image", picture()), ("groundtruth_depth", depth_png([[512] * 4] * 3))):
        write(tmp_path / f"{kind}_gathered" / f"{DRIVE}_02" / "0000000000.png", content)
    (sequence,) = opened("kitti", tmp_path)
    assert (sequence.name, sequence.depth(0).max()) == (DRIVE, 2)


def test_kitti_takes_the_first_110_and_names_what_is_missing(tmp_path):
    kitti_folder(tmp_path, [i for i in range(130) if i not in (7, 9)], range(5, 125))
    (tmp_path / "2011_09_26" / "calib_cam_to_cam.txt").unlink()
    (sequence,) = opened("kitti", tmp_path)
    assert [int(path.stem) for path in sequence.pictures] == [i for i in range(5, 115) if i not in (7, 9)]
    skipped = f"{DRIVE}: 2 of 110 frames have no picture and are skipped: 0000000007, 0000000009; expected "
    assert any(skipped in note for note in sequence.notes)
    assert f"{DRIVE}: it has no intrinsics; expected {tmp_path}/2011_09_26/calib_cam_to_cam.txt" in sequence.notes
    assert np.allclose(sequence.depth(2)[0], [0, 1, 0.5, 265 / 256])  # frame 8


def scene_folder(folder, frames=3):
    """https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes: frame-XXXXXX.color.png, .depth.png in
    millimetres with 65535 for none, .pose.txt camera-to-world 4 x 4; focal length 585, principal point (320, 240)."""
    for i in range(frames):
        write(folder / f"frame-{i:06d}.color.png", picture())
        write(folder / f"frame-{i:06d}.depth.png", depth_png([[0, 65535, 1500, 1000 + i]] * 3))
        pose = np.eye(4)
        pose[:3, :3] = QUARTER_ABOUT_Y
        pose[:3, 3] = [i, 0.5, -1]
        write(folder / f"frame-{i:06d}.pose.txt", "\n".join("\t ".join(f"{x:.7e}" for x in row) for row in pose) + "\n")
    return folder


def test_seven_scenes(tmp_path):
    for name in ("chess/seq-10", "chess/seq-02", "fire/seq-01"):
        scene_folder(tmp_path / name)
    sequences = opened("7scenes", tmp_path)
    assert [sequence.name for sequence in sequences] == ["chess/seq-02", "chess/seq-10", "fire/seq-01"]
    sequence = sequences[1]
    assert sequence.pictures[2] == tmp_path / "chess/seq-10/frame-000002.color.png"
    assert np.allclose(sequence.depth(2), [[0, 0, 1.5, 1.002]] * 3)
    assert np.allclose(sequence.world_from_camera[2], [[0, 0, 1, 2], [0, 1, 0, 0.5], [-1, 0, 0, -1], [0, 0, 0, 1]])
    assert np.array_equal(sequence.intrinsics[0], [[585, 0, 320.5], [0, 585, 240.5], [0, 0, 1]])
    assert "depth is not registered to the pictures; the intrinsics are the depth camera's" in sequence.notes[0]
    folder = tmp_path / "chess" / "seq-02"
    (folder / "frame-000001.pose.txt").unlink()
    (sequence,) = opened("7scenes", folder)
    assert (sequence.name, sequence.posed.tolist()) == ("seq-02", [True, False, True])
    assert f"seq-02: 1 of 3 frames have no pose: frame-000001; expected {folder}/*.pose.txt" in sequence.notes
    write(folder / "frame-000002.pose.txt", "\n".join(["-inf -inf -inf -inf"] * 4))  # as ScanNet marks lost frames
    (sequence,) = opened("7scenes", folder)
    assert sequence.posed.tolist() == [True, False, False]
    assert np.allclose(sequence.world_from_camera[0, :3, 3], [0, 0.5, -1])
    assert opened("7scenes", folder, stride=2)[0].world_from_camera.shape == (2, 4, 4)
    (folder / "frame-000001.color.png").unlink()
    (sequence,) = opened("7scenes", folder)
    assert {each.what: each.frames for each in sequence.left_out}["pictures"] == ("frame-000001",)


WRITERS = {
    "sintel": sintel_folder,
    "kitti": lambda root: kitti_folder(root, range(3), range(3)),
    "7scenes": scene_folder,
}
DEPTH, CAMERA = "training/depth/alley_2/frame_0002.dpt", "training/camdata_left/alley_2/frame_0002.cam"
CALIBRATION, POSE = "2011_09_26/calib_cam_to_cam.txt", "frame-000001.pose.txt"
LARGE = SINTEL_TAG + struct.pack("<ii", 2**31 - 1, 2**31 - 1) + b"\0" * 48


@pytest.mark.parametrize(
    ("data_set", "file", "content", "message"),
    [
        ("sintel", DEPTH, LARGE, r"frame_0002\.dpt"),
        ("sintel", CAMERA, cam(SINTEL_K, 2 * np.eye(3, 4)), "not a rotation"),
        ("kitti", CALIBRATION, "P_rect_03: 1", r"calib_cam_to_cam\.txt has no line"),
        ("7scenes", POSE, "1 0 0 0\n0 2 0 0\n0 0 1 0\n0 0 0 1\n", r"pose\.txt has invalid poses"),
    ],
)
def test_broken_files_are_refused(tmp_path, data_set, file, content, message):
    WRITERS[data_set](tmp_path)
    write(tmp_path / file, content)
    with pytest.raises(InputError, match=message):
        opened(data_set, tmp_path)[0].depth(1)


def test_sintel_scores_the_frames_that_are_whole(tmp_path):
    sintel_folder(tmp_path)
    (whole,) = opened("sintel", tmp_path)
    names = whole.frame_names
    (tmp_path / f"training/camdata_left/alley_2/{names[1]}.cam").unlink()
    (tmp_path / f"training/final/alley_2/{names[0]}.png").unlink()
    (sequence,) = opened("sintel", tmp_path)
    assert sequence.posed.tolist() == [name != names[1] for name in names[1:]]
    np.testing.assert_array_equal(sequence.world_from_camera[sequence.posed], whole.world_from_camera[2:])
    assert np.isfinite(sequence.intrinsics).all()
    assert {each.what: each.frames for each in sequence.left_out} == {"poses": (names[1],), "pictures": (names[0],)}
    with pytest.raises(InputError, match="without --strict"):
        opened("sintel", tmp_path, strict=True)
