"""Known poses: their files, a result that takes them, and the depth and focal length that agree with them."""

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.shared.room import make_room, textured_room
from vggtjax import load_clip
from vggtjax.errors import InputError
from vggtjax.pipeline.known.apply import apply_known
from vggtjax.pipeline.known.consistency import consistent_with_poses
from vggtjax.pipeline.known.given import check_readable, read_known
from vggtjax.pipeline.known.options import KnownGeometry
from vggtjax.pipeline.known.poses import read_poses
from vggtjax.storage.trajectories import write_trajectory


def _kitti(path, poses):
    np.savetxt(path, poses[:, :3].reshape(len(poses), 12))
    return str(path)


def _moved(poses, scale=2.5):
    """Return the same poses in another world: turned, 2.5 times as large, and shifted."""
    turn = Rotation.from_euler("xyz", [0.3, 1.1, -0.4]).as_matrix()
    moved = poses.astype(np.float64)
    moved[:, :3, 3] = scale * moved[:, :3, 3] @ turn.T + [7, -3, 11]
    moved[:, :3, :3] = turn @ moved[:, :3, :3]
    return moved


def test_exact_poses_in_another_world_change_only_the_world(tmp_path):
    room = textured_room(4)
    poses = _moved(room.world_from_camera)
    found, unit = apply_known(room, read_known(KnownGeometry(poses=_kitti(tmp_path / "poses.txt", poses)), room))
    np.testing.assert_allclose(found.world_from_camera, poses, atol=1e-5)
    np.testing.assert_allclose(found.depth, 2.5 * room.depth, rtol=1e-5)
    assert unit == pytest.approx(2.5, rel=1e-5)
    assert found.length_unit == "unit of the poses"


def test_poses_with_times_go_to_their_frames(tmp_path):
    room = make_room(frames=3)  # frames at 0, 1/24 and 2/24 seconds
    poses = make_room(frames=5).world_from_camera
    times = np.array([0, 1 / 48, 1 / 24, 1 / 16, 2 / 24])
    write_trajectory(tmp_path / "poses.txt", poses, times)
    np.testing.assert_allclose(read_poses(tmp_path / "poses.txt", room), poses[::2], atol=1e-6)
    write_trajectory(tmp_path / "poses.txt", poses, times + 5)
    with pytest.raises(InputError, match=r"5 poses and the clip 3 frames; the pose nearest to frame 0 is 5 s away"):
        read_poses(tmp_path / "poses.txt", room)
    write_trajectory(tmp_path / "poses.txt", poses[4::-2], times[4::-2])
    np.testing.assert_allclose(read_poses(tmp_path / "poses.txt", room), poses[::2], atol=1e-6)  # in any order
    named = make_room(frames=3, frame_names=("1305.020833", "1305.041667", "1305.0625"))
    write_trajectory(tmp_path / "poses.txt", poses, times + 1305)
    np.testing.assert_allclose(read_poses(tmp_path / "poses.txt", named), poses[1:4], atol=1e-6)


def test_poses_go_to_pictures_that_are_named_by_nanoseconds(tmp_path):
    names = [str(1403636579763555584 + 50_000_000 * frame) for frame in range(3)]
    for name in names:
        Image.new("RGB", (28, 28)).save(tmp_path / f"{name}.png")
    clip = load_clip(tmp_path, size=28)
    room = make_room(3, timestamps=None, frame_names=tuple(names))  # as a result of an earlier version
    poses = make_room(frames=5).world_from_camera
    seconds = 1403636579.763555584 + 0.025 * np.arange(5)
    for times in (seconds, 1e9 * seconds):  # a file may have nanoseconds, too
        write_trajectory(tmp_path / "poses.txt", poses, times)
        for frames in (clip, room):
            np.testing.assert_allclose(read_poses(tmp_path / "poses.txt", frames), poses[::2], atol=1e-6)
    write_trajectory(tmp_path / "poses.txt", poses, 0.025 * np.arange(5))  # from the first frame
    np.testing.assert_allclose(read_poses(tmp_path / "poses.txt", clip), poses[::2], atol=1e-6)


def test_as_many_poses_as_frames_at_other_times_go_by_their_order(tmp_path, caplog):
    room = make_room(frames=3)
    for times, warned in (([0, 5, 9], True), ([7, 5, 9], False)):
        caplog.clear()
        write_trajectory(tmp_path / "poses.txt", room.world_from_camera, np.array(times))
        np.testing.assert_allclose(read_poses(tmp_path / "poses.txt", room), room.world_from_camera, atol=1e-6)
        assert ("the times of only 1 of 3 are those of frames" in caplog.text) == warned


TURNING = Rotation.from_rotvec(np.arange(6)[:, None] * [0, 0, np.pi / 3]).as_matrix()
PLACE, ROTATION, REPLICATED = np.s_[:, :3, 3], np.s_[:, :3, :3], np.s_[:]


@pytest.mark.parametrize(
    ("part", "change", "message"),
    [
        (ROTATION, lambda turns: 1.1 * turns, "the camera pose of frame 0 is not a rotation"),
        (PLACE, lambda places: 0 * places + [3, 2, 1], r"the 6 poses of .* are at one place, \[3.0, 2.0, 1.0\]"),
        (PLACE, lambda places: np.add(places, [50_000, 58_000, 30]), r"at about \[5000\d.0, .*, too far from"),
        (ROTATION, lambda turns: TURNING @ turns, r"turned from the predicted ones by \d+ degrees"),
        (
            ROTATION,
            lambda turns: turns * [1, -1, -1],
            "by 14 degrees .* if read in OpenGL's axes .*, by 0.0 degrees and 0%",
        ),
        (REPLICATED, np.linalg.inv, r"by \d+ degrees .* if read as camera-from-world, by 0.0 degrees and 0%"),
    ],
)
def test_poses_that_do_not_fit_are_refused(tmp_path, part, change, message):
    room = make_room(frames=6)
    poses = room.world_from_camera.copy()
    poses[part] = change(poses[part])
    with pytest.raises(InputError, match=message):
        apply_known(room, read_known(KnownGeometry(poses=_kitti(tmp_path / "poses.txt", poses)), room))


def _lines(poses, order, times=None):
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=order == "wxyz")
    times = np.arange(len(poses)) if times is None else times
    return [" ".join(f"{value:.9g}" for value in row) for row in np.column_stack([times, poses[:, :3, 3], turns])]


ROOM = make_room(frames=6)
MARK = "\ufeff"


@pytest.mark.parametrize(
    ("header", "order"),
    [
        ("", "xyzw"),
        ("# timestamp tx ty tz qx qy qz qw", "xyzw"),
        ("# timestamp tx ty tz qw qx qy qz", "wxyz"),
        ("# made by a program\n#time,x,y,z,q_w,q_x,q_y,q_z", "wxyz"),
        ("timestamp tx ty tz qw qx qy qz", "wxyz"),
        ("timestamp,p_RS_R_x,p_RS_R_y,p_RS_R_z,q_RS_w,q_RS_x,q_RS_y,q_RS_z", "wxyz"),
        ("Time Pos.X Pos.Y Pos.Z Rot.X Rot.Y Rot.Z Rot.W", "xyzw"),
    ],
)
@pytest.mark.parametrize("mark", ["", MARK])
@pytest.mark.parametrize("comma", [False, True])
def test_the_names_of_the_columns_tell_the_order(tmp_path, header, order, mark, comma):
    lines = "\n".join(_lines(ROOM.world_from_camera, order))
    text = "\n".join([header, lines.replace(" ", ",") if comma else lines])
    (tmp_path / "poses.txt").write_text(mark + text, encoding="utf-8")
    np.testing.assert_allclose(read_poses(tmp_path / "poses.txt", ROOM), ROOM.world_from_camera, atol=1e-6)


@pytest.mark.parametrize("width", [12, 16, 4])
@pytest.mark.parametrize("mark", ["", MARK])
def test_matrices_row_by_row(tmp_path, width, mark):
    poses = ROOM.world_from_camera
    rows = (poses[:, :3] if width == 12 else poses).reshape(-1, width)
    lines = [" ".join(map(repr, row)) for row in rows.tolist()]
    (tmp_path / "p.txt").write_text(mark + "\n".join(lines), encoding="utf-8")
    np.testing.assert_allclose(read_poses(tmp_path / "p.txt", ROOM), poses, atol=1e-6)
    with pytest.raises(InputError, match="has matrices; leave --quaternion out"):
        read_poses(tmp_path / "p.txt", ROOM, "wxyz")


@pytest.mark.parametrize(("written", "read"), [("wxyz", None), ("wxyz", "xyzw"), ("xyzw", "wxyz")])
def test_quaternions_in_another_order_are_named(tmp_path, written, read):
    path = tmp_path / "poses.txt"
    path.write_text("\n".join(_lines(ROOM.world_from_camera, written)))
    np.testing.assert_allclose(read_poses(path, ROOM, written), ROOM.world_from_camera, atol=1e-6)
    message = rf"if read with the quaternion's w .* \(--quaternion {written}\), by 0\.\d degrees and 0%"
    with pytest.raises(InputError, match=message):
        apply_known(ROOM, read_known(KnownGeometry(poses=str(path), quaternion=read), ROOM))


def test_files_of_programs_with_w_first_need_the_order(tmp_path):
    path = tmp_path / "pred_traj.txt"
    path.write_text("\n".join(_lines(ROOM.world_from_camera, "wxyz")))
    with pytest.raises(InputError, match="does not say the order of its quaternions; give --quaternion wxyz"):
        check_readable(KnownGeometry(poses=str(path)))
    check_readable(KnownGeometry(poses=str(path), quaternion="wxyz"))
    with pytest.raises(InputError, match="is of a file of poses; give the file with --poses"):
        KnownGeometry(quaternion="wxyz")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("# t tx ty tz qy qx qz qw\n0 0 0 0 0 0 0 1", "names its columns qy qx qz qw; expected qw first or last"),
        ("nan nan nan nan nan nan nan nan\n0 0 0 0 0 0 0 1", "holds nan; expected finite"),
        ("1 2 3\n", "3 numbers a line; expected 8 or 12 or 16 or 4"),
        ("1 2 3 4\n1 2 3 4\n", "has 2 rows of four numbers"),
    ],
)
def test_files_that_are_no_poses(tmp_path, text, message):
    (tmp_path / "p.txt").write_text(text)
    with pytest.raises(InputError, match=message):
        read_poses(tmp_path / "p.txt", ROOM)


TEXTURED = textured_room(4)
STATIC = ~TEXTURED.dynamic_mask


def test_what_is_right_stays_as_it_is():
    broken = np.where(TEXTURED.dynamic_mask, np.float32(30), TEXTURED.depth)  # movers do not count
    made = consistent_with_poses(textured_room(4, depth=broken), focal_known=False)
    assert made.focal == 1
    np.testing.assert_array_equal(made.depth[STATIC], 1)


def test_one_scale_and_a_smooth_distortion_are_undone():
    across = np.linspace(-1, 1, 84)
    distorted = textured_room(4, depth=TEXTURED.depth * 1.5 * np.exp(0.35 * across).astype(np.float32))
    made = consistent_with_poses(distorted, focal_known=True)
    left = np.abs(made.depth * distorted.depth / TEXTURED.depth - 1)[STATIC]
    assert left.mean() < 0.05
    assert made.cost[1] < made.cost[0]


@pytest.mark.proof
def test_a_wrong_focal_length_is_found():
    wrong = textured_room().intrinsics.copy()
    wrong[:, [0, 1], [0, 1]] *= 1.2
    made = consistent_with_poses(textured_room(intrinsics=wrong), focal_known=False)
    assert made.focal == pytest.approx(1 / 1.2, rel=0.04)
