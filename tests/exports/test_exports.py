"""Results in the formats of other programs, read back by those programs' libraries or by plain readers."""

import os
import re
import subprocess
import sys
from collections import Counter

import numpy as np
import pytest
from PIL import Image

from tests.glb_files import split_glb
from tests.room import make_room
from vggtjax.captures.colmap_model import read_views
from vggtjax.clips.sources import open_source
from vggtjax.commands.main import command_help
from vggtjax.errors import ClipError, InputError, OutputError
from vggtjax.exports.table import FORMATS, Exporting
from vggtjax.exports.write import check_export, export_result
from vggtjax.results.gltf_animation import frame_times

FRAMES, H, W = 4, 84, 126


@pytest.fixture(scope="module")
def result():
    return make_room(FRAMES, H, W, frame_names=[f"a{i}" for i in range(FRAMES)])


@pytest.fixture(scope="module")
def pictures(tmp_path_factory, result):
    """Pictures of the source: twice as large as the result's frames, as .jpg and .png."""
    folder = tmp_path_factory.mktemp("pictures")
    for number, image in enumerate(result.images):
        large = Image.fromarray(image).resize((2 * W, 2 * H))
        large.save(folder / f"a{number}{'.JPG' if number % 2 else '.png'}", "JPEG" if number % 2 else "PNG")
    Image.new("RGB", (2 * W, 2 * H)).save(folder / "a0b.png")  # not of the result
    return folder


@pytest.mark.parametrize(("form", "original"), [("colmap", True), ("colmap-text", False)])
def test_colmap_reads_the_model_and_projects_its_points(tmp_path, result, pictures, form, original):
    pycolmap = pytest.importorskip("pycolmap")
    source = open_source(str(pictures)) if original else None
    export_result(result, tmp_path / "out", form, source=source, exporting=Exporting(1500))
    model = pycolmap.Reconstruction(str(tmp_path / "out/sparse/0"))
    scale = 2 if original else 1
    names = [f"a{i}{('.JPG' if i % 2 else '.png') if original else '.png'}" for i in range(FRAMES)]
    assert sorted(image.name for image in model.images.values()) == names
    images = sorted(model.images.values(), key=lambda image: image.name)
    seen = 0
    for number, image in enumerate(images):
        pose = image.cam_from_world().matrix()
        np.testing.assert_allclose(pose, result.camera_from_world[number], atol=1e-6)
        K = result.intrinsics[number] * np.array([[scale], [scale], [1]])
        np.testing.assert_allclose(image.camera.calibration_matrix(), K, rtol=1e-6)
        assert (image.camera.width, image.camera.height) == (scale * W, scale * H)
        with Image.open(tmp_path / "out/images" / image.name) as picture:
            assert picture.size == (scale * W, scale * H)
        with Image.open(tmp_path / f"out/masks/{image.name}.png") as mask:
            static = np.asarray(mask) > 0
        for observed in image.points2D:
            point = model.points3D[observed.point3D_id]
            np.testing.assert_allclose(image.project_point(point.xyz), observed.xy, atol=0.01)
            column, row = (observed.xy - 1e-9).astype(int)
            assert static[row, column]
            np.testing.assert_array_less(np.abs(point.color.astype(int) - 60) % 40, 1)  # of the wall
            seen += 1
    assert len(model.points3D) > 400
    assert seen > 2 * len(model.points3D)
    if form == "colmap":
        for number, name in enumerate(names):
            view = read_views(tmp_path / "out/sparse/0")[name]
            np.testing.assert_allclose(view.camera_from_world, result.camera_from_world[number], atol=1e-6)
            np.testing.assert_allclose(view.intrinsics[:2] / scale, result.intrinsics[number][:2], rtol=1e-6)


def test_each_frame_of_the_animation_shows_its_own_points(tmp_path, result):
    export_result(result, tmp_path / "scene.glb", "glb-animated")
    tree, values = split_glb((tmp_path / "scene.glb").read_bytes())
    (animation,) = tree["animations"]
    channels = [channel for channel in animation["channels"] if channel["target"]["path"] == "scale"]
    assert len(channels) == FRAMES
    times = frame_times(result)
    for moment in range(FRAMES):
        shown = []
        for channel in channels:
            sampler = animation["samplers"][channel["sampler"]]
            keys, scales = values(sampler["input"])[:, 0], values(sampler["output"])
            assert sampler["interpolation"] == "STEP"
            assert (np.diff(keys) > 0).all()
            at = np.searchsorted(keys, (times[moment] + times[moment + 1]) / 2, side="right") - 1
            if scales[at, 0]:
                shown.append(tree["nodes"][channel["target"]["node"]]["name"])
        assert shown == [f"dynamic_{moment:06d}"]


def test_channels_of_openexr(tmp_path, result):
    exr = pytest.importorskip("OpenEXR")
    export_result(result, tmp_path / "out", "exr")
    channels = exr.File(str(tmp_path / "out/a1.exr"), separate_channels=True).channels()
    np.testing.assert_array_equal(channels["Z"].pixels, result.depth[1])
    np.testing.assert_array_equal(channels["confidence"].pixels, result.depth_confidence[1])
    np.testing.assert_array_equal(channels["moving"].pixels, result.dynamic_mask[1])


def test_rerun_opens_the_recording_and_finds_every_frame(tmp_path, result):
    pytest.importorskip("rerun")
    export_result(result, tmp_path / "out.rrd", "rerun", exporting=Exporting(500))

    command = [sys.executable, "-m", "rerun", "rrd", "print", "-v", str(tmp_path / "out.rrd")]
    environment = os.environ | {"XDG_CONFIG_HOME": str(tmp_path / "config")}  # of its own settings
    printed = subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout
    chunks = re.findall(r"with (\d+) rows .*? - (/\S+) - data columns: \[(.*)\]", printed)
    rows = Counter()
    for count, path, names in chunks:  # a column may lie in several
        rows.update({(column.split("@")[1], path): int(count) for column in names.split()})
    for column, wanted in {
        "ViewCoordinates:xyz": ("/world", 1),
        "LineStrips3D:strips": ("/world/path", 1),
        "Transform3D:translation": ("/world/camera", FRAMES),
        "Pinhole:image_from_camera": ("/world/camera/picture", FRAMES),
        "EncodedImage:blob": ("/world/camera/picture", FRAMES),
        "DepthImage:buffer": ("/world/camera/picture/depth", FRAMES),
        "SegmentationImage:buffer": ("/world/camera/picture/moving", FRAMES),
    }.items():
        assert rows[column, wanted[0]] == wanted[1]
    points = {path: count for (column, path), count in rows.items() if column == "Points3D:positions"}
    assert points == {"/world/static": 1, "/world/moving": FRAMES}


@pytest.mark.parametrize("names", [["../x", "../y", "z", "w"], ["a", "A", "b", "c"], ["x" * 300, "a", "b", "c"]])
def test_unsafe_names_give_way_to_numbers(tmp_path, names):
    export_result(make_room(FRAMES, 28, 42, frame_names=names), tmp_path / "out", "nerfstudio")
    written = sorted(path.name for path in (tmp_path / "out/images").iterdir())
    assert written == [f"{number:06d}.png" for number in range(FRAMES)]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_bad_input_is_refused_and_nothing_is_written(tmp_path, result, pictures):
    (tmp_path / "full").mkdir()
    (tmp_path / "full/mine").touch()
    (tmp_path / "small").mkdir()
    Image.new("RGB", (8, 8)).save(tmp_path / "small/a0.png")
    before = sorted(tmp_path.rglob("*"))
    cases = [
        (OutputError, "exists and is not replaced", tmp_path / "full", "nerfstudio", None),
        (InputError, "ends with .rrd", tmp_path / "scene.glb", "rerun", None),
        (InputError, "expected one of", tmp_path / "out", "ply", None),
        (ClipError, "a0' has 8 x 8 pixels", tmp_path / "out", "nerfstudio", tmp_path / "small"),
        (ClipError, "no frame 'zz'", tmp_path / "out", "nerfstudio", pictures),
    ]
    for kind, words, out, form, folder in cases:
        broken = result if "zz" not in words else make_room(FRAMES, H, W, frame_names=["a0", "zz", "a2", "a3"])
        with pytest.raises(kind, match=words):
            export_result(broken, out, form, source=folder and open_source(str(folder)))
    assert sorted(tmp_path.rglob("*")) == before
    with pytest.raises(InputError, match="points"):
        Exporting(points=0)


def test_the_help_names_every_format():
    rows = [row for group in command_help("export").groups for row in group.rows]
    (text,) = [text for flag, text in rows if flag.startswith("--to")]
    assert set(re.findall(r"[a-z-]+", text.partition("one of ")[2].partition(" (")[0])) == set(FORMATS)


def test_a_repeated_time_keeps_the_rate_of_the_others():
    times = np.arange(12) / 30
    times[5] = times[4]
    np.testing.assert_allclose(frame_times(make_room(12, timestamps=times)), np.arange(13) / 30)


def test_formats_without_pictures_refuse_their_source(tmp_path):
    with pytest.raises(InputError, match="mesh has no pictures, and is made at the model's size; leave --pictures out"):
        check_export(tmp_path / "a.ply", "mesh", pictures=True)
    check_export(tmp_path / "ROOM.PLY", "mesh")
