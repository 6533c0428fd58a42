import json

import numpy as np
import pytest

from tests.shared.dataset_files import camera_json, cameras_bin, images_bin, npy, opened, picture, write
from vggtjax.errors import InputError

FRAMES = 25


def disparity(frame):
    """Largest depth 1 / 0.5 in even frames and 1 / 0.25 in odd ones; in frame 20 one pixel has none."""
    values = np.full((3, 4), 1, np.float32)
    values[0, 0] = 0.25 if frame % 2 else 0.5
    if frame == 20:
        values[2, 3] = 0
    return values


def dycheck_folder(folder, frames=FRAMES):
    """https://github.com/KAIR-BAIR/dycheck/blob/main/docs/DATASETS.md: rgb/<scale>x, depth/<scale>x/*.npy of (H, W, 1)
    float32, camera/*.json, splits/train.json of frame_names, camera_ids, time_ids; flow3d_preprocessed as read by
    flow3d/data/iphone_dataset.py of https://github.com/vye16/shape-of-motion."""
    names = [f"0_{i:05d}" for i in range(frames)]
    split = {"frame_names": names, "camera_ids": [0] * frames, "time_ids": list(range(frames))}
    write(folder / "splits" / "train.json", json.dumps(split))
    extra = folder / "flow3d_preprocessed"
    for i, name in enumerate(names):
        write(folder / "rgb" / "1x" / f"{name}.png", picture())
        write(folder / "camera" / f"{name}.json", camera_json(position=[1.0, 2.0, float(i)]))
        lidar = np.full((3, 4, 1), 1 + i, np.float32)
        lidar[0] = 0
        write(folder / "depth" / "1x" / f"{name}.npy", npy(lidar))
        write(extra / "aligned_depth_anything_colmap" / "1x" / f"{name}.npy", npy(disparity(i)))
    # PINHOLE is model 1: fx fy cx cy, of pictures of twice the size
    write(extra / "colmap" / "sparse" / "cameras.bin", cameras_bin([(1, 1, 8, 6, [16.0, 18.0, 4.5, 3.5])]))
    # in no order, a point list of another length each, as COLMAP leaves them
    images = [(i + 1, (0.5**0.5, 0, 0.5**0.5, 0), (i, 2.0, 3.0), 1, f"{name}.png") for i, name in enumerate(names)]
    write(extra / "colmap" / "sparse" / "images.bin", images_bin(images[::-1]))
    return folder


def test_easi3r(tmp_path):
    dycheck_folder(tmp_path / "apple")
    (sequence,) = opened("dycheck", tmp_path)
    assert sequence.name == "apple"
    assert [path.stem for path in sequence.pictures] == ["0_00000", "0_00010", "0_00020"]
    # the median of the 25 largest depths: 13 even frames, of which one reaches 1 / 1e-3, and 12 odd ones of 4
    limit = 2.5 * 4
    expected = np.ones((3, 4))
    expected[0, 0] = 2
    assert np.allclose(sequence.depth(0), expected)
    expected[2, 3] = limit
    assert np.allclose(sequence.depth(2), expected)
    # COLMAP has camera-from-world: centre -R^T t of t = (20, 2, 3) is (3, -2, -20)
    assert np.allclose(sequence.world_from_camera[2], [[0, 0, -1, 3], [0, 1, 0, -2], [1, 0, 0, -20], [0, 0, 0, 1]])
    assert np.allclose(sequence.intrinsics[0], [[8, 0, 2.25], [0, 9, 1.75], [0, 0, 1]])  # no shift: corners count
    assert sequence.notes[1:] == ("apple: its ground truth is easi3r",)


def test_lidar(tmp_path):
    dycheck_folder(tmp_path / "apple")
    (sequence,) = opened("dycheck", tmp_path, gt="lidar", stride=12)
    assert [path.stem for path in sequence.pictures] == ["0_00000", "0_00012", "0_00024"]
    assert np.allclose(sequence.depth(2), [[0] * 4, [25] * 4, [25] * 4])
    # the file has camera-from-world R and the centre
    assert np.allclose(sequence.world_from_camera[1], [[0, 0, 1, 1], [0, 1, 0, 2], [-1, 0, 0, 12], [0, 0, 0, 1]])
    assert np.allclose(sequence.intrinsics[1], [[8, 0.5, 2.25], [0, 10, 1.75], [0, 0, 1]])
    assert sequence.notes[1:] == ("apple: its ground truth is lidar",)


def test_intrinsics_follow_the_size_of_the_pictures(tmp_path):
    folder = dycheck_folder(tmp_path / "apple", frames=1)
    changes = {"image_size": [8, 6], "principal_point": [4.5, 3.5], "focal_length": 16.0, "skew": 1.0}
    write(folder / "camera" / "0_00000.json", camera_json(radial_distortion=[0, 0.1, 0], **changes))
    (sequence,) = opened("dycheck", tmp_path, gt="lidar")
    assert np.allclose(sequence.intrinsics[0], [[8, 0.5, 2.25], [0, 10, 1.75], [0, 0, 1]])
    assert "apple: lens distortion is not undone, and not part of the intrinsics" in sequence.notes
    write(folder / "camera" / "0_00000.json", camera_json(image_size=[8, 8]))
    with pytest.raises(InputError, match=r"for pictures of 8 x 8 and the picture is 4 x 3"):
        opened("dycheck", tmp_path, gt="lidar")


def test_what_is_missing_is_noted_and_never_taken_from_the_other_truth(tmp_path):
    folder = dycheck_folder(tmp_path / "apple")
    extra = folder / "flow3d_preprocessed"
    (extra / "aligned_depth_anything_colmap" / "1x" / "0_00010.npy").unlink()
    (extra / "colmap" / "sparse" / "images.bin").unlink()
    (folder / "camera" / "0_00020.json").unlink()
    (sequence,) = opened("dycheck", folder)
    assert sequence.world_from_camera is sequence.intrinsics is None
    assert not sequence.depth(1).any()
    assert sequence.notes[2:] == (
        f"apple: it has no cameras; expected {extra}/colmap/sparse/images.bin",
        f"apple: 1 of 3 frames have no depth: 0_00010; expected {extra}/aligned_depth_anything_colmap/1x/*.npy",
    )
    write(extra / "colmap" / "sparse" / "images.bin", images_bin([(1, (1, 0, 0, 0), (0, 0, 0), 1, "0_00000.png")]))
    (sequence,) = opened("dycheck", folder)
    assert "apple: 2 of 3 frames are not in" in sequence.notes[-1]
    assert sequence.posed.tolist() == [True, False, False]
    (sequence,) = opened("dycheck", folder, gt="lidar")
    assert sequence.posed.tolist() == [True, True, False]
    assert sequence.world_from_camera[1, :3, 3].tolist() == [1, 2, 10]
    note = f"apple: 1 of 3 frames have no camera: 0_00020; expected {folder}/camera/*.json"
    assert sequence.notes[2:] == (note,)
    (folder / "rgb/1x/0_00000.png").unlink()
    (sequence,) = opened("dycheck", folder, gt="lidar")
    assert (sequence.frame_names, sequence.posed.tolist()) == (("0_00010", "0_00020"), [True, False])
    with pytest.raises(InputError, match=r"1 of 3 frames have no picture: 0_00000.*without --strict"):
        opened("dycheck", folder, gt="lidar", strict=True)


SPLIT, CAMERA = "splits/train.json", "camera/0_00000.json"


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        (SPLIT, '{"frame_names": ["a"], "time_ids": ' + "[" * 70 + "]" * 70 + "}", "nested more than 64 levels"),
        (SPLIT, '{"frame_names": ["../camera"]}', "expected a path inside"),
        (SPLIT, '{"frame_names": ["0_99999"]}', "names"),
        (CAMERA, camera_json(orientation=[[1, 0, 0], [0, 2, 0], [0, 0, 1]]), "invalid poses"),
        (CAMERA, camera_json(focal_length=0.0), "focal lengths above 0"),
    ],
)
def test_broken_files_are_refused(tmp_path, file, content, message):
    folder = dycheck_folder(tmp_path / "apple", frames=1)
    write(folder / file, content)
    with pytest.raises(InputError, match=rf"\.json.*{message}"):
        opened("dycheck", tmp_path, gt="lidar")
