import numpy as np
import pytest

from tests.shared.dataset_files import QUARTER_ABOUT_Y, depth_png, opened, picture, write
from vggtjax.cameras import checked_poses
from vggtjax.errors import InputError


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
    turn, stamps = f"0 {0.5**0.5:.7f} 0 {0.5**0.5:.7f}", times if pose_times is None else pose_times
    rows = [f"{time:.4f} {i} 0.5 0.25 {turn}" for i, time in enumerate(stamps)]
    write(folder / "groundtruth.txt", "\n".join(["# timestamp tx ty tz qx qy qz qw", *rows, ""]))
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
        "fr2_desk: lens distortion is not undone, and not part of the intrinsics",
        f"fr2_desk: 2 of 300 frames have no pose within 0.02 s and are skipped: {times[4]:.6f}, {times[5]:.6f}",
    )
    assert sequence.intrinsics[0, 0].tolist() == [520.9, 0, 325.6]
    assert np.allclose(opened("tum", tmp_path, stride=30)[0].timestamps, times[there][::30], atol=1e-6)


def test_tum_without_partners(tmp_path):
    times = 50 + np.arange(4) / 10
    folder = tum_folder(tmp_path / "somewhere", times, depth_times=times[:2] + 0.019, pose_times=times + 0.021)
    (sequence,) = opened("tum", folder, stride=1)
    assert sequence.world_from_camera is sequence.intrinsics is None
    notes, missing = " ".join(sequence.notes), "2 of 4 frames have no depth: 50.200000, 50.300000"
    assert all(words in notes for words in ("no frame has a pose within 0.02 s", "its camera is unknown", missing))
    assert [sequence.depth(frame).any() for frame in (1, 2)] == [True, False]
    write(folder / "calibration.txt", "# fx fy cx cy\n500 501 320 240\n")
    (sequence,) = opened("tum", folder, stride=1)
    assert np.array_equal(sequence.intrinsics[3], [[500, 0, 320.5], [0, 501, 240.5], [0, 0, 1]])


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("rgb.txt", "1.0 /etc/passwd\n", "names the file '/etc/passwd'; expected a path inside"),
        ("rgb.txt", "1.0 rgb/nothing.png\n" * 40, "nothing.png is missing"),
        ("groundtruth.txt", "1.0 0 0 0 0 0 0 2\n", "quaternion of length 2"),
    ],
)
def test_lists_that_cannot_be_right_are_refused(tmp_path, file, content, message):
    folder = tum_folder(tmp_path / "clip", 1 + np.arange(40) / 30)
    write(tmp_path / "secret.png", picture())
    write(folder / file, content)
    with pytest.raises(InputError, match=message.replace("\\", r"\\")):
        opened("tum", folder)


def test_bonn(tmp_path):
    times = 10 + np.arange(150) / 30
    tum_folder(tmp_path / "rgbd_bonn_crowd2", times)
    (sequence,) = opened("bonn", tmp_path)
    assert (sequence.name, len(sequence)) == ("crowd2", 110)
    assert np.allclose(sequence.timestamps, times[30:140], atol=1e-6)
    assert sequence.depth(0)[0, 3] == np.float32(5031 / 5000)
    tum_folder(tmp_path / "lost" / "crowd2", times, pose_times=np.delete(times, [2, 40]))
    (lost,) = opened("bonn", tmp_path / "lost")  # the window stays where poses are missing
    assert (len(lost), np.flatnonzero(~lost.posed).tolist()) == (110, [10])
    assert np.allclose(np.delete(lost.world_from_camera[:, :3, :3], 10, axis=0), sequence.world_from_camera[0, :3, :3])
    assert f"crowd2: 1 of 110 frames have no pose within 0.02 s: {times[40]:.6f}" in lost.notes
    assert sequence.notes[0].startswith("4 of 5 published sequences of bonn are missing: balloon2, crowd3, person_tr")
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
