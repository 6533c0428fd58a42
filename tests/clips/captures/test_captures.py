"""Captures of every kind: known points fall on the squares that the pictures have, and broken captures are refused."""

import json
import shutil
import zipfile
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.clips.captures import folders
from tests.clips.captures.folders import FRAMES, HEIGHT, WIDTH, make_truth
from vggtjax.cameras import project
from vggtjax.clips.captures.cameras import DISTORTED
from vggtjax.clips.captures.table import KINDS, find_capture, read_capture
from vggtjax.clips.clip import load_clip
from vggtjax.clips.media.sampling import Sampling
from vggtjax.clips.sources import clips_by_name, open_source
from vggtjax.errors import ClipError, InputError, MissingExtraError

read: Any = read_capture  # of no type: a test knows what there is
find: Any = find_capture
TRUTH = make_truth()
SHARED = make_truth(shared=True)
NAMES = {
    "record3d": [str(frame) for frame in range(FRAMES)],
    "polycam": [f"{638443502000 + 100_000 * frame}" for frame in range(FRAMES)],
    "nerfstudio": [f"frame_{8 + frame}" for frame in range(FRAMES)],
    "colmap": [f"view_{8 + frame}" for frame in range(FRAMES)],
    "tum": [f"{100 + frame / 10:.6f}" for frame in range(FRAMES)],
}


def write(kind, folder):
    if kind == "record3d":
        pytest.importorskip("lzfse")
    writer = folders.colmap_text if kind == "colmap" else getattr(folders, kind)
    return writer(folder, SHARED if kind == "tum" else TRUTH)


def check(capture, truth, *, smaller=1, sure=10.0, atol=1e-6):
    """Points fall on the squares of their own picture, within `atol` pixels of where they were drawn."""
    np.testing.assert_allclose(capture.intrinsics, truth.intrinsics, atol=1e-9)
    assert capture.sizes == ((WIDTH, HEIGHT),) * FRAMES
    assert not capture.distorted
    for frame, path in enumerate(capture.pictures):
        pose = np.linalg.inv(capture.world_from_camera[frame])[:3]
        x, y, z = project(truth.points, pose, capture.intrinsics[frame])
        np.testing.assert_allclose(np.stack([x, y], axis=1), truth.pixels[frame], atol=atol)
        with Image.open(path) as picture:
            brightness = np.asarray(picture.convert("L"))
        assert (brightness[y.astype(int), x.astype(int)] > 200).all()
        if (depth := capture.depth(frame)) is None:
            continue
        at = (y / smaller).astype(int), (x / smaller).astype(int)
        np.testing.assert_allclose(depth[at], np.where(z < sure, z, 0), atol=6e-4)  # half a millimetre of rounding


@pytest.mark.parametrize("kind", KINDS)
def test_points_fall_on_their_squares(tmp_path, kind):
    capture = find(write(kind, tmp_path / "scene"))
    assert capture.kind == kind
    assert list(capture.frame_names) == NAMES[kind]
    arkit = kind in ("record3d", "polycam")
    truth = SHARED if kind == "tum" else TRUTH
    check(capture, truth, smaller=2 if arkit else 1, sure=2.75 if arkit else 10, atol=1e-5)
    assert (capture.depth(0) is None) == (kind == "colmap")
    assert capture.metric == (kind not in ("colmap", "nerfstudio"))
    assert capture.notes == ()
    if kind in ("record3d", "polycam", "tum"):
        np.testing.assert_allclose(np.diff(capture.timestamps), 1 / 30 if kind == "record3d" else 0.1, atol=1e-6)


def test_a_file_of_record3d_is_its_folder(tmp_path):
    folder = write("record3d", tmp_path / "scene")
    capture = read(folders.zipped(folder, tmp_path / "walk.r3d"))
    check(capture, TRUTH, smaller=2, sure=2.75, atol=1e-5)
    assert open_source(str(tmp_path / "walk.r3d")).name == "walk"
    part, place = capture.for_frames(["2"]), capture.pictures[0].parent
    assert read(tmp_path / "walk.r3d").pictures[0].parent == place  # not unpacked again
    del capture
    assert part.pictures[0].is_file()
    del part
    assert not place.exists()
    K = json.loads((folder / "metadata").read_text())["K"]
    assert K[6:8] == [50, 33]  # column after column
    old = read(folders.record3d(tmp_path / "old", SHARED, perFrameIntrinsicCoeffs=None, frameTimestamps=None))
    check(old, SHARED, smaller=2, sure=2.75, atol=1e-5)
    np.testing.assert_allclose(old.timestamps, np.arange(FRAMES) / 30)


def test_an_export_of_record3d_to_exr_and_jpg(tmp_path):
    pytest.importorskip("lzfse")
    pytest.importorskip("OpenEXR")
    folder = folders.record3d_export(tmp_path, TRUTH)
    capture = find(folder)
    assert (capture.kind, list(capture.frame_names)) == ("record3d", NAMES["record3d"])
    check(capture, TRUTH, smaller=2, atol=1e-5)
    (folder / "depth/0.exr").write_bytes(b"no depth")
    with pytest.raises(InputError, match="an OpenEXR file that can be read"):
        capture.depth(0)
    (folder / "depth/0.exr").unlink()
    assert read(folder).depth(0) is None


def test_polycam_s_own_cameras_stand_in_for_optimised_ones(tmp_path):
    capture = read(folders.polycam(tmp_path, TRUTH, corrected=False))
    assert capture.distorted
    assert capture.notes == ("its poses are ARKit's own: Polycam did not optimise them", DISTORTED)
    np.testing.assert_allclose(capture.world_from_camera, TRUTH.world_from_camera, atol=1e-12)
    assert capture.undistorted() is capture  # its coefficients are unknown
    first = next((tmp_path / "keyframes/cameras").iterdir())
    edited(first, k1=0.1, p2=0.01)
    K = TRUTH.intrinsics[0] if first.stem == capture.frame_names[0] else None
    lens = next(filter(None, read(tmp_path).lenses))
    assert (lens.model, lens.params[4:]) == ("OPENCV", (0.1, 0, 0, 0.01))
    assert K is None or lens.params[:4] == (K[0, 0], K[1, 1], K[0, 2], K[1, 2])


def test_numbers_at_the_top_of_transforms_json(tmp_path):
    K = SHARED.intrinsics[0]
    top = {"w": WIDTH, "h": HEIGHT, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    drop = dict.fromkeys(("w", "h", "fl_x", "fl_y", "cx", "cy"))
    check(read(folders.nerfstudio(tmp_path / "top", SHARED, top=top, frame_fields=drop)), SHARED)
    angle = {"camera_angle_x": 2 * np.arctan(WIDTH / 2 / 80)}
    blender = read(folders.nerfstudio(tmp_path / "blender", SHARED, top=angle, frame_fields=drop))
    np.testing.assert_allclose(blender.intrinsics[0], [[80, 0, WIDTH / 2], [0, 80, HEIGHT / 2], [0, 0, 1]])
    halved = {"w": 2 * WIDTH, "h": 2 * HEIGHT, "cx": 100.0, "cy": 66.0, "fl_x": 160.0, "fl_y": 156.0}
    check(read(folders.nerfstudio(tmp_path / "half", SHARED, frame_fields=halved)), SHARED)
    text = (tmp_path / "top/transforms.json").read_text()
    (tmp_path / "top/transforms.json").unlink()
    (tmp_path / "top/transforms_train.json").write_text(text.replace('.png", "depth', '", "depth'))  # as Blender's
    check(find(tmp_path / "top"), SHARED)
    lens = read(folders.nerfstudio(tmp_path / "lens", SHARED, top={"k1": 0.1}))
    assert lens.distorted
    assert lens.notes == (DISTORTED,)


def test_what_nerfstudio_applied_to_the_world_is_undone(tmp_path):
    applied = np.array([[0.0, 0, 1, 0.3], [1, 0, 0, -0.2], [0, 1, 0, 0.1]])  # as its reader of Polycam, and a shift
    scale = 0.25
    folder = folders.nerfstudio(tmp_path, TRUTH, top={"applied_transform": applied.tolist(), "applied_scale": scale})
    scene = json.loads((folder / "transforms.json").read_text())
    for frame in scene["frames"]:
        moved = np.vstack([applied, [0, 0, 0, 1]]) @ frame["transform_matrix"]
        moved[:3, 3] *= scale
        frame["transform_matrix"] = moved.tolist()
    (folder / "transforms.json").write_text(json.dumps(scene))
    check(read(folder), TRUTH)


@pytest.mark.parametrize("model", ["sparse/0", "sparse", "colmap/sparse/0"])
def test_places_of_a_colmap_model(tmp_path, model, caplog):
    check(read(folders.colmap_text(tmp_path, TRUTH, model)), TRUTH)
    if model == "sparse/0":
        check(find(tmp_path / model), TRUTH)  # the model's own folder, with the pictures above it
    Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / "images/unseen.png")
    note = "1 of 5 pictures have no pose and are left out, unseen first"
    assert read(tmp_path).notes == (note,)
    load_clip(tmp_path, size=28, patch=14)
    assert caplog.text.count(note) == 1


@pytest.mark.parametrize(
    ("parts", "taken"),
    [
        ({"0": ([0, 1], 90, ".txt"), "1": (range(FRAMES), 5, ".txt")}, "sparse/1"),
        ({"0": ([0, 1], 90, ".bin"), "2": (range(FRAMES), 5, ".bin"), "10": ([2], 0, ".txt")}, "sparse/2"),
        ({"0": (range(FRAMES), 5, ".txt"), "1": (range(FRAMES), 7, ".bin")}, "sparse/1"),
        ({"2": (range(FRAMES), 5, ".bin"), "10": (range(FRAMES), 5, ".txt")}, "sparse/2"),
        ({"0": ([3], 5, ".bin"), "": (range(FRAMES), 5, ".txt")}, "sparse"),
    ],
)
def test_of_several_colmap_models_that_with_most_pictures_is_read(tmp_path, caplog, parts, taken):
    folders.colmap_text(tmp_path, TRUTH, "whole")
    for number, part in parts.items():
        folders.write_colmap(tmp_path / "sparse" / number, TRUTH, *part)
    capture = read(tmp_path)
    check(capture, TRUTH)
    (note,) = capture.notes
    assert f"of {len(parts)} COLMAP models {taken} is read" in note
    for number, (frames, points, _) in parts.items():
        name = f"sparse/{number}".rstrip("/")
        assert f"{name} has {len(frames)} pictures and {points} points" in note
    load_clip(tmp_path, size=28, patch=14)
    assert caplog.text.count(note) == 1


def test_pictures_that_are_not_there_do_not_count_and_a_broken_model_is_no_choice(tmp_path):
    folders.colmap_text(tmp_path, TRUTH, "whole")
    folders.write_colmap(tmp_path / "sparse/0", TRUTH)
    lost = (tmp_path / "sparse/0/images.txt").read_text()
    for frame in range(8, 11):
        lost = lost.replace(f"view_{frame}.png", f"lost_{frame}.png")
    (tmp_path / "sparse/0/images.txt").write_text(lost)  # one picture of it is there
    for number, form in (("1", ".txt"), ("3", ".bin")):
        folders.write_colmap(tmp_path / "sparse" / number, TRUTH, [0, 2], form=form)
    (tmp_path / "sparse/3/images.bin").write_bytes(b"short")
    capture = read(tmp_path)
    assert capture.frame_names == ("view_8", "view_10")
    assert "sparse/0 has 1 pictures" in capture.notes[0]
    assert "sparse/3 cannot be read" in capture.notes[0]


def test_frames_keep_their_cameras_by_name(tmp_path):
    folder = write("nerfstudio", tmp_path / "scene")
    clip = load_clip(folder, size=28, patch=14, start=1, stride=2)
    assert (clip.frame_names, clip.source.name) == (["frame_9", "frame_11"], "scene")
    chosen = read(folder).for_frames(reversed(clip.frame_names))
    np.testing.assert_array_equal(chosen.intrinsics, TRUTH.intrinsics[[3, 1]])
    np.testing.assert_allclose(chosen.world_from_camera, TRUTH.world_from_camera[[3, 1]])
    np.testing.assert_allclose(chosen.depth(0)[chosen.depth(0) > 0].min(), TRUTH.depth[3].min(), atol=1e-5)
    np.save(folder / "depth/3.npy", np.ones((WIDTH, HEIGHT), np.float32))
    with pytest.raises(InputError, match=r"3\.npy has 72 x 96 pixels and its picture 96 x 72; expected the same shape"):
        chosen.depth(0)
    assert chosen.frame_names == ("frame_11", "frame_9")
    with pytest.raises(InputError, match="has no frame 'frame_8'; it has 2 frames, from 'frame_11' to 'frame_9'"):
        chosen.for_frames(["frame_8"])


def test_equal_stems_of_two_folders_are_told_apart(tmp_path):
    folder = write("nerfstudio", tmp_path / "scene")
    scene = json.loads((folder / "transforms.json").read_text())
    for frame, name in zip(scene["frames"], ("b/1.png", "b/0.png", "a/1.png", "a/0.png"), strict=True):
        (folder / f"images/{name}").parent.mkdir(exist_ok=True)
        (folder / frame["file_path"]).rename(folder / f"images/{name}")
        frame["file_path"] = f"images/{name}"
    (folder / "transforms.json").write_text(json.dumps(scene))
    capture = read(folder)
    assert capture.frame_names == ("a_0", "a_1", "b_0", "b_1")
    check(capture, TRUTH)
    part = capture.for_frames(["b_1", "a_1"])
    assert part.for_frames(["a_1"]).pictures == (folder / "images/a/1.png",)
    assert [frame.name for frame in open_source(str(folder)).frames(Sampling())] == ["a_0", "a_1", "b_0", "b_1"]


@pytest.mark.parametrize(
    ("kind", "orientation", "words"),
    [
        ("nerfstudio", 3, "is stored upside down or mirrored"),
        ("nerfstudio", 6, "stored on their side are read upright, as their EXIF .*mogrify -auto-orient"),
        ("colmap", 8, "stored on their side are read upright"),
    ],
)
def test_cameras_of_stored_pixels_name_exif(tmp_path, kind, orientation, words):
    folder = write(kind, tmp_path / "scene")
    path = next(folder.rglob("*.png"))
    with Image.open(path) as picture:
        picture.load()
        picture.getexif()[0x0112] = orientation
        picture.save(path, exif=picture.getexif())
    with pytest.raises(InputError, match=words):
        read(folder)


def test_times_of_a_capture_choose_frames_by_second(tmp_path):
    source = open_source(str(write("tum", tmp_path / "scene")))
    taken = list(source.frames(Sampling(fps=5)))
    assert [frame.name for frame in taken] == ["100.000000", "100.200000"]
    assert [frame.time and round(frame.time, 6) for frame in taken] == [0, 0.2]
    assert source.total(Sampling(fps=5)) == 2
    assert list(clips_by_name([str(tmp_path)])) == ["scene"]  # a batch
    lines = (tmp_path / "scene/groundtruth.txt").read_text().splitlines()
    (tmp_path / "scene/groundtruth.txt").write_text("\n".join(lines[:2] + lines[3:]))
    capture = read(tmp_path / "scene")
    assert capture.notes == ("1 of 4 pictures have no pose within 0.02 s and are left out, 100.100000 first",)
    np.testing.assert_allclose(capture.world_from_camera, SHARED.world_from_camera[[0, 2, 3]], atol=1e-6)
    (tmp_path / "scene/groundtruth.txt").unlink()
    assert read(tmp_path / "scene").world_from_camera is None


def test_folders_that_are_no_capture(tmp_path):
    Image.new("RGB", (8, 8)).save(tmp_path / "a.png")
    (tmp_path / "images.txt").write_text("my pictures")
    assert find(tmp_path) is None
    for name in ("keyframes/b.png", "rgb/1x/0.png"):  # chosen pictures; the layout of Nerfies
        (tmp_path / name).parent.mkdir(parents=True)
        shutil.copy(tmp_path / "a.png", tmp_path / name)
    (tmp_path / "metadata.json").write_text("{}")
    assert find(tmp_path) is None
    assert find(tmp_path / "a.png") is find(tmp_path / "nothing") is None
    with pytest.raises(InputError, match="is no capture; expected a folder of Record3D"):
        read(tmp_path)


def edited(path, **changes):
    """Change fields of a JSON file, in every frame of a scene."""
    value = json.loads(path.read_text())
    for target in value.get("frames", [value]):
        target.update(changes)
    path.write_text(json.dumps(value))


def edit(name, **changes):
    return lambda folder: edited(folder / name, **changes)


def text(name, content):
    return lambda folder: (folder / name).write_text(content)


def without(name):
    return lambda folder: shutil.rmtree(folder / name) if (folder / name).is_dir() else (folder / name).unlink()


IMAGES, CAMERAS, SCENE = "sparse/0/images.txt", "sparse/0/cameras.txt", "transforms.json"
BROKEN = [
    ("nerfstudio", without("images/frame_9.png"), "frame_9.png is missing, but .*transforms.json names"),
    ("nerfstudio", text("transforms.json", '{"frames": [3]}'), "has no list 'frames'"),
    ("nerfstudio", edit(SCENE, file_path="../secret.png"), "expected a path inside"),
    ("nerfstudio", edit(SCENE, transform_matrix=np.ones((4, 4)).tolist()), "invalid poses"),
    ("nerfstudio", edit(SCENE, fl_x=0), "focal lengths above 0"),
    ("nerfstudio", edit(SCENE, w=HEIGHT, h=WIDTH), "expected the same shape"),
    ("nerfstudio", edit(SCENE, camera_model="EQUIRECTANGULAR"), "model EQUIRECTANGULAR; expected one of FULL_OPENCV"),
    ("record3d", edit("metadata", dw=10**9), "has depth of 1000000000 x 36 pixels"),
    ("colmap", text(IMAGES, "1 1 0 0 0 0 0 0 1 ../a.png"), "expected a path inside"),
    ("colmap", text(CAMERAS, f"1 PINHOLE {'9' * 400} 9 1 1 1 1"), "expected sides of 1 to 1000000"),
    ("tum", text("groundtruth.txt", "5 0 0 0 0 0 0 1"), "no picture of .* has a pose within 0.02 s"),
]


@pytest.mark.parametrize(("kind", "spoil", "words"), BROKEN)
def test_a_broken_capture_is_refused_in_one_sentence(tmp_path, kind, spoil, words):
    folder = write(kind, tmp_path / "scene")
    spoil(folder)
    with pytest.raises(InputError, match=words):
        find(folder)
    with pytest.raises(ClipError, match="name the folder of the pictures to leave its cameras out"):
        open_source(str(folder))


def test_archives_that_are_none_or_too_large_or_leave_their_folder(tmp_path):
    path = folders.zipped(write("record3d", tmp_path / "scene"), tmp_path / "walk.r3d", **{"rgbd\\..\\out": b"x"})
    with pytest.raises(InputError, match="expected a path inside"):
        read(path)
    path.write_bytes(b"PK\3\4 no zip")
    with pytest.raises(InputError, match="is not a whole zip, as Record3D writes it"):
        read(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("metadata", bytes(80 << 20))
    with pytest.raises(InputError, match="has 1 files of 83886080 bytes; expected at most"):
        read(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("walk/metadata", "{}")
    with pytest.raises(InputError, match=r"walk\.r3d has no metadata at its top; .* zip the content of a folder"):
        read(path)


def test_depth_of_record3d_is_bounded_and_needs_its_extra(tmp_path, monkeypatch):
    folder = write("record3d", tmp_path)
    import lzfse

    capture = read(folder)
    path = folder / "rgbd/0.depth"
    large = lzfse.compress(bytes(100_000))
    for data, words in ((b"bvx2" * 40, "is not a map of"), (b"bvx2" + bytes(40), "cannot"), (large, "36 x 48 values")):
        path.write_bytes(data)  # each block of the first could hold 26 MB
        with pytest.raises(InputError, match=words):
            capture.depth(0)
    monkeypatch.setattr("vggtjax.errors.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"needs the extra 'record3d'"):
        capture.depth(1)
