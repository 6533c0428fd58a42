import logging
import shutil

import numpy as np
import pytest
from PIL import Image

from tests.shared.dataset_files import depth_png, opened, picture, png, write
from vggtjax.clips.media.sampling import Sampling
from vggtjax.errors import InputError
from vggtjax.research.evaluation.datasets import DATASETS, find_sequences, published
from vggtjax.research.evaluation.datasets.plain import takes
from vggtjax.research.evaluation.datasets.sequence import FrameChoice

EYE = " ".join(map(str, np.eye(4).ravel()))


def plain_folder(folder, frames=3, poses=None):
    for i in range(frames):
        write(folder / "rgb" / f"{i:02d}.png", picture())
        write(folder / "depth" / f"{i:02d}.png", depth_png(np.full((3, 4), 1000 * i)))
        write(folder / "mask" / f"{i:02d}.png", png(np.eye(3, 4, dtype=np.uint8) * 255))
    write(folder / "K.txt", "8 0 2\n0 9 1.5\n0 0 1\n")
    write(folder / "world_from_camera.txt", "\n".join([EYE] * frames if poses is None else poses))
    return folder


def test_frames_are_a_window_then_a_stride_then_a_cap():
    assert set(published.DAVIS_2016) < set(published.DAVIS_2017)
    assert {name: row.max_depth for name, row in DATASETS.items() if row.max_depth} == {"bonn": 70, "sintel": 70}
    assert DATASETS["dycheck"].frames.of(range(35), "dycheck") == [0, 10, 20, 30]
    assert DATASETS["kitti"].frames.of(range(1000), "kitti") == list(range(110))
    assert FrameChoice(slice(2, 9), 3, 2).of(range(20), "a") == [2, 5]
    of_bonn = FrameChoice(slice(30, 140)).sampled(Sampling(start=2, stride=2, skip="2,5-6", max_frames=3))
    assert of_bonn.of(range(200), "a") == [34, 38, 40]  # 32 and 36 are frames 2 and 6 of the window
    assert FrameChoice(slice(30, 140)).of(range(100), "a") == list(range(30, 100))
    assert FrameChoice(slice(30, 140)).shortage(100) == ("it has 100 frames; the protocol takes 30 to 139",)
    with pytest.raises(InputError, match="sequence a has 30 frames, none of them from frame 30 on"):
        FrameChoice(slice(30, 140)).of(range(30), "a")


def test_plain_folder(tmp_path):
    folder = plain_folder(tmp_path / "clip")
    (sequence,) = opened("plain", folder)
    assert (sequence.name, len(sequence), sequence.notes) == ("clip", 3, ())
    assert [path.name for path in sequence.pictures] == ["00.png", "01.png", "02.png"]
    assert np.array_equal(sequence.depth(2), np.full((3, 4), 2, np.float32))  # metres
    assert not sequence.depth(0).any()
    assert np.array_equal(sequence.mask(1), np.eye(3, 4, dtype=bool))
    assert np.array_equal(sequence.intrinsics[1], [[8, 0, 2], [0, 9, 1.5], [0, 0, 1]])  # as it is, without a shift
    assert np.array_equal(sequence.world_from_camera, np.tile(np.eye(4), (3, 1, 1)))
    plain_folder(tmp_path / "clip10")
    write(tmp_path / ".hidden" / "rgb" / "0.png", picture())
    first, second = opened("plain", tmp_path, stride=2)
    assert (first.name, second.name) == ("clip", "clip10")
    assert [path.name for path in second.pictures] == ["00.png", "02.png"]
    assert second.depth(1).max() == 2
    assert [sequence.name for sequence in opened("plain", tmp_path, sequences=["clip10"])] == ["clip10"]


def test_pictures_that_are_missing_count_where_they_would_be_taken(tmp_path):
    folder = plain_folder(tmp_path / "clip", frames=8)
    (folder / "rgb/01.png").unlink()
    (folder / "rgb/06.png").unlink()
    for choice, lost, total in (
        ({}, ("01", "06"), 8),
        ({"max_frames": 3}, ("01",), 4),  # of 00, 02 and 03
        ({"max_frames": 1, "strict": True}, (), 0),
        ({"stride": 3}, ("06",), 3),  # of 00 and 04
    ):
        (sequence,) = opened("plain", folder, **choice)
        left = [(each.frames, each.total) for each in sequence.left_out if each.what == "pictures"]
        assert left == [(lost, total)] * bool(lost)


@pytest.mark.parametrize(
    ("depth", "mask"), [("npy", "jpg"), ("uint16.npy", "webp"), ("exr", "tif"), ("npz", "npy"), ("npy and png", "png")]
)
def test_other_kinds_of_depth_and_masks(tmp_path, depth, mask):
    folder, labels = plain_folder(tmp_path / "clip", frames=2), np.zeros((3, 4), np.uint8)
    labels[:, 2:] = 255
    if mask != "png":
        shutil.rmtree(folder / "mask")
        (folder / "mask").mkdir()
    if depth != "npy and png":
        shutil.rmtree(folder / "depth")
        (folder / "depth").mkdir()
    for i in range(2):
        metres = np.full((3, 4), 1.5 + i, np.float32)
        if depth.endswith("exr"):
            OpenEXR = pytest.importorskip("OpenEXR")
            OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, {"Z": metres}).write(str(folder / f"depth/0{i}.exr"))
        elif depth == "npz":
            np.savez(folder / f"depth/0{i}.npz", metres)
        else:
            values = (metres * 1000).astype(np.uint16) if depth == "uint16.npy" else metres
            np.save(folder / f"depth/0{i}.npy", values)
        if mask == "npy":
            np.save(folder / f"mask/0{i}.npy", labels)
        elif mask != "png":
            Image.fromarray(labels).save(folder / f"mask/0{i}.{mask}")
    (sequence,) = opened("plain", folder)
    expected = {"npz": None, "npy and png": 1.0}.get(depth, 2.5)
    assert (None if sequence.depth is None else sequence.depth(1).max()) == expected
    assert (sequence.mask is None) == (mask == "npy")
    if sequence.mask is not None and mask != "png":
        assert np.array_equal(sequence.mask(1)[:, [0, 3]], labels[:, [0, 3]] > 0)
    expected = [f"clip: it has no depth; expected {folder / 'depth' / '*.png'}"] * (depth == "npz")
    expected += ["clip: 2 files of its folder depth are not read, such as 00.npz"] * (depth == "npz")
    expected += ["clip: 2 files of its folder mask are not read, such as 00.npy"] * (mask == "npy")
    assert list(sequence.notes) == expected


def test_takes_split_where_the_camera_jumps(tmp_path):
    x = np.array([0, 0, 0, 0, 1, 2, 3, 3, 3, 3, 30, 31])  # pauses, steps of 1, a jump of 27
    assert takes(np.outer(x, [1, 0, 0])) == [range(10), range(10, 12)]
    assert takes(np.zeros((4, 3))) == [range(4)]
    poses = [f"1 0 0 {x} 0 1 0 0 0 0 1 0" for x in (0, 0.1, 0.2, 9, 9.1)]
    folder = plain_folder(tmp_path / "walk", frames=5, poses=poses)
    first, second = opened("hololens", folder)
    assert (first.name, len(first)) == ("walk 0-2", 3)
    assert (second.name, len(second)) == ("walk 3-4", 2)
    assert second.world_from_camera[:, 0, 3].tolist() == [9, 9.1]
    assert second.depth(1).max() == 4


def test_what_is_missing_is_noted(tmp_path):
    folder = plain_folder(tmp_path / "clip")
    for name in ("depth/01.png", "mask/02.png", "K.txt", "world_from_camera.txt"):
        (folder / name).unlink()
    (sequence,) = opened("plain", folder)
    assert sequence.notes == (
        f"clip: it has no world_from_camera.txt; expected {folder}/world_from_camera.txt",
        f"clip: it has no K.txt; expected {folder}/K.txt",
        f"clip: 1 of 3 frames have no depth: 01; expected {folder}/depth/*.png",
        f"clip: 1 of 3 frames have no mask: 02; expected {folder}/mask/*.png",
    )
    assert sequence.world_from_camera is sequence.intrinsics is sequence.mask(2) is None
    assert sequence.mask(1).any()
    assert not sequence.depth(1).any()


def test_one_bad_sequence_does_not_hide_the_others(tmp_path):
    plain_folder(tmp_path / "good")
    write(plain_folder(tmp_path / "bad") / "world_from_camera.txt", "1 2 3\n")
    write(tmp_path / "far" / "rgb.txt", f"0.0 {'n' * 300}.png\n")
    found = find_sequences("plain", tmp_path)
    assert list(found) == ["bad", "good"]
    assert len(found["good"]()) == 3
    with pytest.raises(InputError, match="has 3 numbers"):
        found["bad"]()
    with pytest.raises(InputError, match="cannot read sequence far: File name too long"):
        find_sequences("tum", tmp_path)["far"]()


def test_arguments_that_cannot_work(tmp_path):
    plain_folder(tmp_path / "clip")
    with pytest.raises(InputError, match=r"'other' of plain is not in .*; it has clip"):
        opened("plain", tmp_path, sequences=["clip", "other"])
    with pytest.raises(InputError, match="gt is 'colmap'; dycheck has easi3r and lidar"):
        opened("dycheck", tmp_path, gt="colmap")


@pytest.mark.parametrize("name", DATASETS)
def test_an_empty_folder_is_refused(tmp_path, name):
    with pytest.raises(InputError, match=r"holds no .*; expected"):
        opened(name, tmp_path)
    with pytest.raises(InputError, match="is not a folder"):
        opened(name, tmp_path / "nowhere")
    (tmp_path / "rgb").mkdir()
    with pytest.raises(InputError, match="holds no "):
        opened("plain", tmp_path)


def davis_folder(root, *names, frames=2):
    # DAVIS 2017: JPEGImages and Annotations/480p, PNG with a palette (davischallenge.org/davis2017/code.html)
    for name in names:
        for i in range(frames):
            path = root / "JPEGImages" / "480p" / name / f"{i:05d}.jpg"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.new("RGB", (4, 3)).save(path)
            labels = np.array([[0, 1, 2, 0], [0] * 4, [0, 0, 3, 0]], np.uint8)
            palette = [0, 0, 0, 128, 0, 0, 0, 128, 0, 0, 0, 0]  # the colour of label 3 is black too
            write(root / "Annotations" / "480p" / name / f"{i:05d}.png", png(labels, palette))
    return root


def test_davis_moves_where_any_label_is(tmp_path):
    (sequence,) = opened("davis-2017", davis_folder(tmp_path, "gold-fish"))
    expected = np.array([[0, 1, 1, 0], [0, 0, 0, 0], [0, 0, 1, 0]], bool)
    assert np.array_equal(sequence.mask(1), expected)
    assert sequence.depth is sequence.world_from_camera is None
    nothing, ones = np.zeros((3, 4), np.uint8), expected.astype(np.uint8)
    opaque = np.stack([nothing, ones, nothing, np.full((3, 4), 255, np.uint8)], -1)
    for pixels in (ones, opaque[..., :3], opaque):
        write(tmp_path / "Annotations" / "480p" / "gold-fish" / "00000.png", png(pixels))  # grey, colour, opacity
        assert np.array_equal(sequence.mask(0), expected)
    write(tmp_path / "Annotations" / "480p" / "gold-fish" / "00001.png", b"GIF89a")
    with pytest.raises(InputError, match="expected PNG"):
        sequence.mask(1)


def test_published_sequences_that_are_absent_are_named_and_logged(tmp_path, caplog):
    davis_folder(tmp_path, "soapbox", "bear", "camel")
    with caplog.at_level(logging.WARNING):
        sequences = opened("davis", tmp_path)
    assert [sequence.name for sequence in sequences] == ["camel", "soapbox"]
    absent, left = sequences[0].notes
    assert absent.startswith("18 of 20 published sequences of davis are missing: blackswan, bmx-trees")
    assert left == "skipped, as in the published protocol of davis: bear"
    assert caplog.messages == [absent, left]
    assert [sequence.name for sequence in opened("davis", tmp_path, sequences=["bear"])] == ["bear"]
    (bear,) = opened("davis", davis_folder(tmp_path / "other", "bear"))  # of which none is published
    assert bear.notes == ("none of the 20 published sequences of davis is present; took all others",)
