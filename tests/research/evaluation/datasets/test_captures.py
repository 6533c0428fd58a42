import numpy as np
import pytest

from tests.clips.captures import folders
from tests.clips.captures.folders import FRAMES, HEIGHT, WIDTH, make_truth
from tests.shared.dataset_files import opened
from vggtjax.clips.captures.table import read_capture
from vggtjax.errors import InputError

TRUTH = make_truth()


def test_a_capture_is_a_sequence(tmp_path):
    folders.polycam(tmp_path / "kitchen", TRUTH)
    folders.nerfstudio(tmp_path / "porch", TRUTH)
    kitchen, porch = opened("capture", tmp_path, stride=2)
    assert [kitchen.name, porch.name] == ["kitchen", "porch"]
    for sequence in (kitchen, porch):
        assert len(sequence) == FRAMES // 2
        np.testing.assert_allclose(sequence.world_from_camera, TRUTH.world_from_camera[::2])
        np.testing.assert_allclose(sequence.intrinsics, TRUTH.intrinsics[::2])
    assert kitchen.notes == ()
    assert porch.notes == ("porch: its unit is not the metre, but one of its program's own",)
    assert porch.frame_names == ("frame_8", "frame_10")
    depth = kitchen.depth(1)  # of pixels twice as large as the picture's
    assert depth.shape == (HEIGHT, WIDTH)
    (column, row), z = np.floor(TRUTH.pixels[2][0]).astype(int), TRUTH.depth[2][0]
    even = row // 2 * 2, column // 2 * 2
    np.testing.assert_allclose(depth[even[0] : even[0] + 2, even[1] : even[1] + 2], z, atol=6e-4)
    assert not depth[even[0] - 1, column]


def test_files_of_record3d_stand_beside_folders(tmp_path):
    pytest.importorskip("lzfse")
    (tmp_path / "all").mkdir()
    folder = folders.record3d(tmp_path / "unpacked", TRUTH)
    folders.zipped(folder, tmp_path / "all/walk.r3d")
    folders.colmap_text(tmp_path / "all/walk", TRUTH)
    yard, walk = sorted(opened("capture", tmp_path / "all"), key=lambda sequence: sequence.name)
    assert (yard.name, walk.name) == ("walk", "walk.r3d")
    assert walk.depth(0).any()
    assert walk.pictures[0].is_file()  # of an archive that only the sequence keeps
    assert yard.notes[-1] == "walk: it has no depth"


@pytest.mark.parametrize(
    ("write", "picture", "depth"),
    [
        (folders.polycam, "keyframes/corrected_images/*.jpg", "keyframes/depth/*.png"),
        (folders.nerfstudio, "images/*.png", "*/*.png"),
        (folders.colmap_text, "images/*.png", None),
        (folders.tum, "rgb/*.png", "depth/*.png"),
    ],
)
def test_pictures_and_maps_that_are_missing_leave_their_frames_out(tmp_path, write, picture, depth):
    folder = write(tmp_path / "clip", TRUTH)
    (whole,) = opened("capture", folder)
    lost = sorted(folder.glob(picture))[1]
    place = whole.pictures.index(lost)
    lost.unlink()
    (sequence,) = opened("capture", folder)
    assert len(sequence) == FRAMES - 1
    np.testing.assert_array_equal(sequence.world_from_camera, np.delete(whole.world_from_camera, place, axis=0))
    (left,) = sequence.left_out
    assert (left.what, left.frames, left.total) == ("pictures", (lost.stem,), FRAMES)
    assert any(f"1 of {FRAMES} frames have no picture: {lost.stem}" in note for note in sequence.notes)
    with pytest.raises(InputError, match=f"have no picture: {lost.stem}; add them"):
        opened("capture", folder, strict=True)
    with pytest.raises(InputError, match="the capture whole"):
        read_capture(folder)
    if depth is not None:
        maps = sorted(path for path in folder.glob(depth) if path not in whole.pictures)
        maps[-1].unlink()
        (sequence,) = opened("capture", folder)
        assert {each.what: len(each.frames) for each in sequence.left_out} == {"pictures": 1, "depth": 1}
