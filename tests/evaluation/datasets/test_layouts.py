"""Layouts of published data sets: files written byte by byte, values worked out by hand, and files that are broken."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.dataset_files import SINTEL_TAG, cam, depth_png, dpt, opened, picture, write
from vggtjax.errors import InputError
from vggtjax.evaluation.datasets.depth_files import read_dpt
from vggtjax.evaluation.datasets.tum import partners
from vggtjax.evaluation.metrics.trajectory import checked_poses

QUARTER_ABOUT_Y = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]


def tum_folder(folder, times, depth_times=None, pose_times=None):
    """https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats: lists of "timestamp filename", poses of
    "timestamp tx ty tz qx qy qz qw", comments after #, 16-bit PNG of which 5000 is a metre."""
    lists = {"rgb": times, "depth": times if depth_times is None else depth_times}
    for kind, stamps in lists.items():
        lines = [f"# {kind} images", "# timestamp filename"]
        for i, time in enumerate(stamps):
            content = picture() if kind == "rgb" else depth_png([[0, 5000, 2500, 5001 + i]] * 3)
            write(folder / kind / f"{time:.6f}.png", content)
            lines.append(f"{time:.6f} {kind}/{time:.6f}.png")
        write(folder / f"{kind}.txt", "\n".join(lines) + "\n")
    half = np.sqrt(0.5)
    rows = [
        f"{time:.4f} {i} 0.5 0.25 0 {half:.7f} 0 {half:.7f}"
        for i, time in enumerate(times if pose_times is None else pose_times)
    ]
    write(folder / "groundtruth.txt", "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(rows) + "\n")
    return folder


def test_tum(tmp_path):
    times = 1305031000 + np.arange(7) / 30
    folder = tum_folder(tmp_path / "rgbd_dataset_freiburg3_walking_xyz", times, depth_times=times + 0.01)
    (sequence,) = opened("tum", tmp_path)
    assert sequence.name == "freiburg3_walking_xyz"
    assert sequence.pictures == tuple(folder / "rgb" / f"{time:.6f}.png" for time in times[::3])  # every third
    assert np.allclose(sequence.timestamps, times[::3], atol=1e-6)
    assert np.allclose(sequence.depth(1), [[0, 1, 0.5, 5004 / 5000]] * 3)
    assert np.allclose(sequence.world_from_camera[:, :3, :3], QUARTER_ABOUT_Y, atol=1e-6)
    assert np.allclose(sequence.world_from_camera[:, :3, 3], [[0, 0.5, 0.25], [3, 0.5, 0.25], [6, 0.5, 0.25]])
    # https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats#intrinsic_camera_calibration_of_the_kinect; its
    # points are of whole pixel numbers, so half a pixel is added
    assert np.array_equal(sequence.intrinsics[2], [[535.4, 0, 320.6], [0, 539.2, 248.1], [0, 0, 1]])
    assert len(sequence.notes) == 1
    assert sequence.notes[0].startswith("7 of 8 published sequences of tum are missing: freiburg3_sitting_static")


def test_tum_takes_frames_with_a_pose_then_every_third_then_ninety(tmp_path):
    times = 100 + np.arange(300) / 30
    there = np.delete(np.arange(300), [4, 5])
    tum_folder(tmp_path / "fr2_desk", times, pose_times=times[there])
    (sequence,) = opened("tum", tmp_path)
    assert np.allclose(sequence.timestamps, times[there][::3][:90], atol=1e-6)
    assert np.allclose(sequence.world_from_camera[:, 0, 3], np.arange(298)[::3][:90])  # the number of the pose
    assert sequence.notes[1:] == (
        f"fr2_desk: 2 of 300 frames have no pose within 0.02 s and are skipped, {times[4]:.6f} first",
        "fr2_desk: lens distortion is not undone, and not part of the intrinsics",
    )
    assert sequence.intrinsics[0, 0].tolist() == [520.9, 0, 325.6]
    assert np.allclose(opened("tum", tmp_path, stride=30)[0].timestamps, times[there][::30], atol=1e-6)


def test_tum_without_partners(tmp_path):
    times = 50 + np.arange(4) / 10
    folder = tum_folder(tmp_path / "somewhere", times, depth_times=times[:2] + 0.019, pose_times=times + 0.021)
    (sequence,) = opened("tum", folder, stride=1)
    assert sequence.world_from_camera is sequence.intrinsics is None
    assert [note.removeprefix("somewhere: ") for note in sequence.notes[1:]] == [
        "no frame has a pose within 0.02 s",
        "its camera is unknown; name the folder after the camera, or put fx fy cx cy in calibration.txt",
        "2 of 4 frames have no depth, 50.200000 first",
    ]
    assert sequence.depth(1).any()
    assert not sequence.depth(2).any()
    write(folder / "calibration.txt", "# fx fy cx cy\n500 501 320 240\n")
    (folder / "depth.txt").unlink()
    (folder / "groundtruth.txt").unlink()
    (sequence,) = opened("tum", folder, stride=1)
    assert np.array_equal(sequence.intrinsics[3], [[500, 0, 320.5], [0, 501, 240.5], [0, 0, 1]])
    assert sequence.notes[1:] == ("somewhere: it has no groundtruth.txt", "somewhere: it has no depth")


@pytest.mark.parametrize("name", ["tum", "bonn"])
@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("rgb.txt", "1.0 /etc/passwd\n", "names the file '/etc/passwd'; expected a path inside"),
        ("rgb.txt", "1.0 rgb/../../secret.png\n", "names the file 'rgb/../../secret.png'"),
        ("rgb.txt", "1.0 C:\\secret.png\n", "names the file 'C:"),
        ("rgb.txt", "1.0 ..\\secret.png\n", "expected a path inside"),
        ("depth.txt", "1.0 ../depth/1.png\n", "expected a path inside"),
        ("rgb.txt", "1.0 rgb/nothing.png\n" * 40, "nothing.png is missing"),
        ("rgb.txt", "soon rgb/1.png\n", "in line 1; expected a timestamp and a path"),
        ("rgb.txt", "# only\n1.0\n", "in line 2; expected a timestamp and a path"),
        ("rgb.txt", "nan rgb/1.png\n", "in line 1; expected a timestamp and a path"),
        ("rgb.txt", "# nothing\n", "names no files"),
        ("rgb.txt", b"\xff\xfe\x00", "not a text file"),
        ("groundtruth.txt", "1.0 0 0 0 0 0 0\n", "groundtruth.txt has 7 numbers"),
        ("groundtruth.txt", "1.0 0 0 0 0 0 0 2\n", "quaternion of length 2"),
    ],
)
def test_lists_that_cannot_be_right_are_refused(tmp_path, name, file, content, message):
    folder = tum_folder(tmp_path / "clip", 1 + np.arange(40) / 30)
    write(tmp_path / "secret.png", picture())
    write(folder / file, content)
    with pytest.raises(InputError, match=message.replace("\\", r"\\")):
        opened(name, folder)


def test_an_unknown_calibration_is_refused(tmp_path):
    folder = tum_folder(tmp_path / "clip", [1.0])
    write(folder / "calibration.txt", "500 500 320 240\n1 1 1 1\n")
    with pytest.raises(InputError, match="2 rows; expected one: fx fy cx cy"):
        opened("tum", folder)


def slow_associate(first, second, apart):
    """All pairs, closest first: what the benchmark's tool does, without its shortcuts or ours."""
    pairs = sorted(
        (abs(a - b), a, b, i, j) for i, a in enumerate(first) for j, b in enumerate(second) if abs(a - b) < apart
    )
    partners = [-1] * len(first)
    for _, _, _, i, j in pairs:
        if partners[i] < 0 and j not in partners:
            partners[i] = j
    return partners


seconds = st.lists(st.integers(0, 60).map(lambda n: n / 200), min_size=1, max_size=12)


@settings(max_examples=200, deadline=None)
@given(first=seconds, second=seconds)
def test_association_is_that_of_all_pairs(first, second):
    assert partners(np.array(first), np.array(second)).tolist() == slow_associate(first, second, 0.02)


def test_association_by_hand():
    # 0.03 is nearer to 0.02 than 0.0 is, so 0.0 is left without
    assert partners(np.array([0.005, 0.03, 1]), np.array([0.02])).tolist() == [-1, 0, -1]
    assert partners(np.array([1.0, 2.0]), np.array([2.02, 1.019])).tolist() == [1, -1]  # less than, not up to


def test_bonn(tmp_path):
    times = 10 + np.arange(150) / 30
    tum_folder(tmp_path / "rgbd_bonn_crowd2", times)
    (sequence,) = opened("bonn", tmp_path)
    assert sequence.name == "crowd2"
    assert len(sequence) == 110
    assert np.allclose(sequence.timestamps, times[30:140], atol=1e-6)
    assert sequence.depth(0)[0, 3] == np.float32(5031 / 5000)
    assert sequence.notes[0] == (
        "4 of 5 published sequences of bonn are missing: balloon2, crowd3, person_tracking2, synchronous"
    )
    # https://www.ipb.uni-bonn.de/data/rgbd-dynamic-dataset: camera calibration, and the way from markers to camera
    assert np.allclose(sequence.intrinsics[0], [[542.822841, 0, 316.09352], [0, 542.57687, 238.256098], [0, 0, 1]])
    checked_poses(sequence.world_from_camera[:, :3])
    ros = np.array([[-1, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    markers = np.array([[1.0157, 0.1828, -0.2389], [0.0009, -0.8431, -0.6413], [-0.3009, 0.6147, -0.8085]])
    truth = np.eye(4)
    truth[:3, :3] = QUARTER_ABOUT_Y
    truth[:3, 3] = [30, 0.5, 0.25]
    centre = ros @ truth @ ros @ [0.0113, -0.0098, 0.0111, 1]
    assert np.allclose(sequence.world_from_camera[0, :3, 3], centre[:3], atol=1e-6)
    # a scaled rotation: what is left of the published matrix when its scale of 1.059 is taken out
    scaled = (ros @ truth @ ros)[:3, :3] @ markers / np.cbrt(np.linalg.det(markers))
    assert np.allclose(sequence.world_from_camera[0, :3, :3], scaled, atol=1e-3)


def test_bonn_keeps_its_window_where_poses_are_missing(tmp_path):
    times = 10 + np.arange(60) / 30
    tum_folder(tmp_path / "rgbd_bonn_crowd2", times, pose_times=np.delete(times, [2, 40]))
    (sequence,) = opened("bonn", tmp_path)
    assert np.allclose(sequence.timestamps, times[30:], atol=1e-6)
    assert sequence.world_from_camera is None
    assert "crowd2: it has 60 frames; the protocol takes 30 to 139" in sequence.notes
    assert f"crowd2: 1 of 30 frames have no pose within 0.02 s, {times[40]:.6f} first; no poses" in sequence.notes


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


@pytest.mark.parametrize("inner", [False, True])
def test_sintel(tmp_path, inner):
    training = sintel_folder(tmp_path)
    (sequence,) = opened("sintel", training if inner else tmp_path)
    assert sequence.name == "alley_2"
    assert [path.name for path in sequence.pictures] == ["frame_0001.png", "frame_0002.png", "frame_0003.png"]
    assert np.array_equal(sequence.depth(1), np.arange(12).reshape(3, 4) + 2)
    assert np.array_equal(sequence.intrinsics[0], [[1120, 0, 512], [0, 1120, 218], [0, 0, 1]])  # the middle
    # x_cam = R X + t: R is a quarter turn, so the centre -R^T t of t = (2, 2, 3) is (3, -2, -2)
    assert np.allclose(sequence.world_from_camera[1], [[0, 0, -1, 3], [0, 1, 0, -2], [1, 0, 0, -2], [0, 0, 0, 1]])


def test_sintel_bytes():
    """What the files must start with, spelt out: 202021.25 as a little-endian float is PIEH."""
    assert dpt([[1.5]]) == b"PIEH" + b"\x01\0\0\0" + b"\x01\0\0\0" + b"\0\0\xc0\x3f"
    assert len(cam(np.eye(3), np.eye(3, 4))) == 172


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"PIEH",
        dpt(np.ones((3, 4)))[:-1],
        dpt(np.ones((3, 4))) + b"\0",
        b"HEIP" + dpt(np.ones((3, 4)))[4:],
        SINTEL_TAG + struct.pack("<ii", 2**31 - 1, 2**31 - 1) + b"\0" * 48,
        SINTEL_TAG + struct.pack("<ii", -3, -4) + b"\0" * 48,
        SINTEL_TAG + struct.pack("<ii", 0, 0),
    ],
)
def test_broken_sintel_depth_is_refused(tmp_path, content):
    with pytest.raises(InputError, match=r"a\.dpt"):
        read_dpt(write(tmp_path / "a.dpt", content))


def test_depth_that_is_not_known_is_0(tmp_path):
    training = sintel_folder(tmp_path)
    values = [[np.nan, np.inf, -np.inf, -1], [0, 1, 2, 3], [4, 5, 6, 1e9]]
    write(training / "depth" / "alley_2" / "frame_0001.dpt", dpt(values))
    depth = opened("sintel", tmp_path)[0].depth(0)
    assert np.allclose(depth, [[0, 0, 0, 0], [0, 1, 2, 3], [4, 5, 6, 1e9]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (cam(SINTEL_K, np.eye(3, 4))[:-8], "has 164 bytes"),
        (b"HEIP" + cam(SINTEL_K, np.eye(3, 4))[4:], "the tag of a Sintel camera"),
        (cam(SINTEL_K, 2 * np.eye(3, 4)), "not a rotation"),
        (cam(np.zeros((3, 3)), np.eye(3, 4)), "focal lengths above 0"),
        (cam(SINTEL_K, np.full((3, 4), np.nan)), "not finite"),
    ],
)
def test_broken_sintel_cameras_are_refused(tmp_path, content, message):
    training = sintel_folder(tmp_path)
    write(training / "camdata_left" / "alley_2" / "frame_0002.cam", content)
    with pytest.raises(InputError, match=message):
        opened("sintel", tmp_path)


def test_sintel_without_ground_truth(tmp_path):
    training = sintel_folder(tmp_path)
    for kind in ("depth", "camdata_left"):
        for path in (training / kind / "alley_2").iterdir():
            path.unlink()
    (sequence,) = opened("sintel", tmp_path)
    assert sequence.depth is sequence.world_from_camera is sequence.intrinsics is None
    assert sequence.notes[1:] == (
        "alley_2: it has no depth",
        "alley_2: 3 of 3 frames have no camera, frame_0001 first; no cameras",
    )
    for path in (training / "final" / "alley_2").iterdir():
        path.unlink()
    with pytest.raises(InputError, match="alley_2 has no frames"):
        opened("sintel", tmp_path)


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


def test_kitti_takes_the_first_110_and_names_what_is_missing(tmp_path):
    kitti_folder(tmp_path, [i for i in range(130) if i not in (7, 9)], range(5, 125))
    (tmp_path / "2011_09_26" / "calib_cam_to_cam.txt").unlink()
    (sequence,) = opened("kitti", tmp_path)
    assert [int(path.stem) for path in sequence.pictures] == [i for i in range(5, 115) if i not in (7, 9)]
    assert f"{DRIVE}: 2 of 110 frames have no picture and are skipped, 0000000007 first" in sequence.notes
    assert f"{DRIVE}: it has no calib_cam_to_cam.txt, so no intrinsics" in sequence.notes
    assert np.allclose(sequence.depth(2)[0], [0, 1, 0.5, 265 / 256])  # frame 8


def test_kitti_gathered(tmp_path):
    for i in range(3):
        write(tmp_path / "image_gathered" / f"{DRIVE}_02" / f"{i:010d}.png", picture())
        write(tmp_path / "groundtruth_depth_gathered" / f"{DRIVE}_02" / f"{i:010d}.png", depth_png([[512] * 4] * 3))
    (sequence,) = opened("kitti", tmp_path)
    assert (sequence.name, len(sequence)) == (DRIVE, 3)
    assert (sequence.depth(0) == 2).all()


def test_broken_kitti_is_refused(tmp_path):
    kitti_folder(tmp_path, range(3), range(3))
    calibration = tmp_path / "2011_09_26" / "calib_cam_to_cam.txt"
    for content, message in (
        ("P_rect_02: 1 2 3", "no line"),
        ("P_rect_03: 1", "no line"),
        ("P_rect_02: " + "1 " * 11, "11"),
    ):
        write(calibration, content)
        with pytest.raises(InputError, match=rf"calib_cam_to_cam\.txt has {message}"):
            opened("kitti", tmp_path)
    for path in (tmp_path / "2011_09_26" / DRIVE / "image_02" / "data").iterdir():
        path.unlink()
    with pytest.raises(InputError, match=r"data holds no \.png"):
        opened("kitti", tmp_path)


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
    assert sequence.notes == (
        "chess/seq-10: depth is not registered to the pictures; the intrinsics are the depth camera's",
    )
    assert [s.name for s in opened("7scenes", tmp_path / "chess")] == ["seq-02", "seq-10"]
    assert [s.name for s in opened("7scenes", tmp_path / "chess" / "seq-02")] == ["seq-02"]


def test_seven_scenes_with_missing_and_broken_poses(tmp_path):
    folder = scene_folder(tmp_path / "seq-01")
    pose = folder / "frame-000001.pose.txt"
    for content, message in (
        ("1 0 0 0\n0 1 0 0\n0 0 1 0\n", r"pose\.txt has 3 rows; expected a pose of 4 rows"),
        ("1 0 0\n0 1 0\n0 0 1\n0 0 0\n", r"pose\.txt has 3 numbers"),
        ("1 0 0 inf\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", r"pose\.txt holds inf"),
        ("1 0 0 0\n0 2 0 0\n0 0 1 0\n0 0 0 1\n", r"pose\.txt has invalid poses"),
    ):
        write(pose, content)
        with pytest.raises(InputError, match=message):
            opened("7scenes", folder)
    pose.unlink()
    (sequence,) = opened("7scenes", folder)
    assert sequence.world_from_camera is None
    assert "seq-01: 1 of 3 frames have no pose, frame-000001 first; no poses" in sequence.notes
    assert opened("7scenes", folder, stride=2)[0].world_from_camera.shape == (2, 4, 4)


def test_quaternions_of_the_fixture_are_the_quarter_turn():
    assert np.allclose(Rotation.from_quat([0, 0.5**0.5, 0, 0.5**0.5]).as_matrix(), QUARTER_ABOUT_Y)
