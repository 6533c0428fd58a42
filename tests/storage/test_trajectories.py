import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.shared.room import make_room
from vggtjax.errors import ResultError
from vggtjax.storage.trajectories import Quaternion, read_trajectory, write_trajectory


def test_by_hand(tmp_path):
    # A quarter turn about z (x to y) at (1, 2, 3): q = (0, 0, sin 45, cos 45).
    pose = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    write_trajectory(tmp_path / "t", pose[None], np.array([1305031102.175304]))
    header, line = (tmp_path / "t").read_text().splitlines()
    assert header == "# timestamp tx ty tz qx qy qz qw (world-from-camera)"
    assert line.split()[0] == "1305031102.175304"
    np.testing.assert_allclose(np.array(line.split()[1:], float), [1, 2, 3, 0, 0, 0.5**0.5, 0.5**0.5], atol=1e-7)
    lines: dict[Quaternion, str] = {
        "xyzw": "5, 1 2 3 0 0 0.7071 0.7071",
        "wxyz": "5 1 2 3 0.7071 0 0 0.7071 # a pose",
    }
    for order, words in lines.items():
        (tmp_path / "t").write_text(f"# a comment\n\n{words}")
        times, poses = read_trajectory(tmp_path / "t", order)
        assert times.tolist() == [5]
        np.testing.assert_allclose(poses[0], pose, atol=1e-7)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(turn=st.tuples(*[st.floats(-4, 4)] * 3), centre=st.tuples(*[st.floats(-1e3, 1e3)] * 3))
def test_poses_come_back(tmp_path, turn, centre):
    rotation = Rotation.from_rotvec(turn).as_matrix().T
    camera_from_world = np.concatenate([rotation, -rotation @ np.array(centre)[:, None]], axis=1)[None]
    room = make_room(1, camera_from_world=camera_from_world)
    write_trajectory(tmp_path / "t", room.world_from_camera, np.zeros(1))
    assert np.loadtxt(tmp_path / "t")[7] >= 0
    np.testing.assert_allclose(read_trajectory(tmp_path / "t")[1], room.world_from_camera, rtol=1e-6, atol=1e-5)


def test_the_order_of_a_file_is_kept_and_checked(tmp_path):
    poses = make_room().world_from_camera
    for order in ("wxyz", "xyzw"):
        write_trajectory(tmp_path / "t", poses, np.arange(3.0), quaternion=order)
        np.testing.assert_allclose(read_trajectory(tmp_path / "t", order)[1], poses, atol=1e-6)
    with pytest.raises(ResultError, match="names its columns qx qy qz qw; read it with quaternion='xyzw'"):
        read_trajectory(tmp_path / "t", "wxyz")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty; expected 8 numbers a line"),
        (b"0 0 0 0 0 0 0 1\n0 0 0 0 0 0 1\n", "is not a table of 8 numbers a line"),
        (b"0 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 nan\n", "holds nan; expected finite numbers"),
        (b"0 0 0 zero 0 0 0 1\n", "is not a table of 8 numbers"),
        (b"0 0 0 " + b"0" * 2**16 + b"\n", "has a line of over 65536 letters; expected numbers"),
        (b"0 0 0 0 0 0 0 2\n", r"has a quaternion of length 2\.000 in pose 0; expected 1"),
    ],
)
def test_what_is_no_trajectory(tmp_path, content, message):
    (tmp_path / "t").write_bytes(content)
    with pytest.raises(ResultError, match=message):
        read_trajectory(tmp_path / "t")
