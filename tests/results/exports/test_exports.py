"""Results in the formats of other programs, read back by those programs' libraries or by plain readers."""

import csv
import json
import os
import re
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.shared.glb_files import split_glb
from tests.shared.room import make_room
from vggtjax.cameras import project
from vggtjax.clips.captures.colmap_model import read_views
from vggtjax.clips.sources import open_source
from vggtjax.errors import ClipError, InputError, OutputError
from vggtjax.interface.commands.main import print_help
from vggtjax.results.exports.names import picture_names, safe_names
from vggtjax.results.exports.table import FORMATS, Exporting
from vggtjax.results.exports.write import check_export, export_result
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
    for number, image in enumerate(images):
        pose = image.cam_from_world().matrix()
        np.testing.assert_allclose(pose, result.camera_from_world[number], atol=1e-6)
        K = result.intrinsics[number] * np.array([[scale], [scale], [1]])
        np.testing.assert_allclose(image.camera.calibration_matrix(), K, rtol=1e-6)
        assert (image.camera.width, image.camera.height) == (scale * W, scale * H)
        with Image.open(tmp_path / "out/images" / image.name) as picture:
            assert picture.size == (scale * W, scale * H)
        with Image.open(tmp_path / f"out/masks/{image.name}.png") as mask:
            assert np.asarray(mask).shape == (scale * H, scale * W)
        assert image.num_points2D() == 0
    assert len(model.points3D) > 400
    for point in model.points3D.values():
        assert (point.error, point.track.length()) == (-1, 0)  # no frame measured it
        np.testing.assert_array_less(np.abs(point.color.astype(int) - 60) % 40, 1)  # of the wall
        pixels = [image.project_point(point.xyz) for image in images]
        assert any(pixel is not None and (pixel >= 0).all() for pixel in pixels)


@pytest.mark.parametrize("original", [False, True])
def test_tracks_of_the_result_are_the_observations_of_colmap(tmp_path, result, pictures, original):
    """Tracks that are right but for one position, which is 3 pixels off: the error of its point says so."""
    pycolmap = pytest.importorskip("pycolmap")
    middle = (np.arange(W) - W / 2) ** 2 < (W / 6) ** 2
    static = np.argwhere(~result.dynamic_mask[1] & result.valid_pixels[1] & middle)
    rows, columns = static[:: len(static) // 4][:3].T
    query = np.column_stack([columns, rows]) + 0.5
    inside = np.column_stack([query, np.ones(3)]) @ np.linalg.inv(result.intrinsics[1]).T
    inside *= result.depth[1, rows, columns, None]
    world = (inside - result.camera_from_world[1, :, 3]) @ result.camera_from_world[1, :, :3]
    cameras = zip(result.camera_from_world.astype(float), result.intrinsics.astype(float), strict=True)
    positions = np.stack([np.column_stack(project(world, pose, K)[:2]) for pose, K in cameras])
    positions[3, 0] += (0, 3)
    moving = np.argwhere(result.dynamic_mask[1])[0][::-1] + 0.5
    positions = np.concatenate([positions, np.broadcast_to(moving, (FRAMES, 1, 2))], axis=1)
    visibility = np.full((FRAMES, 4), 0.9)
    visibility[2, 1] = 0.1  # hidden there
    tracks = {"track_positions": positions, "track_visibility": visibility, "track_confidence": visibility}
    tracked = replace(result, **tracks, track_frames=np.ones(4, int))
    source = open_source(str(pictures)) if original else None
    export_result(tracked, tmp_path / "out", "colmap", source=source, exporting=Exporting(50))
    model = pycolmap.Reconstruction(str(tmp_path / "out/sparse/0"))
    measured = [point for point in model.points3D.values() if point.track.length()]
    inside = ((positions[:, :3] >= 0) & (positions[:, :3] < (W, H))).all(axis=2) & (visibility[:, :3] >= 0.5)
    lengths = [point.track.length() for point in measured]
    assert sorted(lengths) == sorted(inside.sum(axis=0).tolist())
    np.testing.assert_allclose(sorted(p.xyz[0] for p in measured), sorted(world[:, 0]), atol=1e-4)
    assert inside[3, 0]
    (wrong,) = [point for point in measured if point.error > 0.01]
    np.testing.assert_allclose(wrong.error, (2 if original else 1) * 3 / inside[:, 0].sum(), rtol=1e-3)
    assert any(point.error == -1 for point in model.points3D.values())


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


@pytest.mark.parametrize(
    ("names", "written"),
    [
        (["a", "A", "b", "c"], ["a", "A_000001", "b", "c"]),
        (["a", "x" * 300, "b", "c"], ["a", "x" * 196, "b", "c"]),
        (["ü", "u\u0308", "IMG (1)", "a+b,c&d#e%f'g"], ["ü", "u\u0308_000001", "IMG (1)", "a+b,c&d#e%f'g"]),
        (["con", "LPT1.x", "a:b", "end."], ["_con", "_LPT1.x", "a_b", "end_"]),
        (["../x", "/etc/y", "C:\\z", ".hidden"], ["_/x", "etc/y", "C__z", "_hidden"]),
        (["", "..", "a\x00b", "a"], ["_", "__000001", "a_b", "a"]),
        (["a.png", "a.png/b", "c/d", "c"], ["a.png", "a.png/b", "c/d", "c"]),
        (["a", "a.png/b", "c", "c"], ["a", "a.png_b", "c", "c_000003"]),
    ],
)
def test_only_names_that_a_system_cannot_hold_are_changed(tmp_path, caplog, names, written):
    export_result(make_room(FRAMES, 28, 42, frame_names=names), tmp_path / "out", "nerfstudio")
    frames = json.loads((tmp_path / "out/transforms.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == [f"images/{name}.png" for name in written]
    for frame in frames:
        for kind in ("file_path", "depth_file_path", "mask_path"):
            assert (tmp_path / "out" / frame[kind]).is_file()
    assert len({frame["depth_file_path"] for frame in frames}) == FRAMES
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    changed = [(f"{old}.png", f"{new}.png") for old, new in zip(names, written, strict=True) if old != new]
    table = tmp_path / "out/renamed.csv"
    assert table.exists() == bool(changed) == ("have another name in the export" in caplog.text)
    if changed:
        with table.open(newline="", encoding="utf-8") as file:
            assert list(map(tuple, csv.reader(file))) == [("name", "exported as"), *changed]


@pytest.mark.parametrize("form", ["colmap", "colmap-text", "nerfstudio"])
def test_names_of_files_with_folders_survive_as_the_format_holds_them(tmp_path, form):
    if form != "nerfstudio":
        pytest.importorskip("pycolmap")
    names = ["cam0/0001.png", "cam0/Küche & Bad, 100%.jpg", "cam1/0001.png", "cam1/IMG (1).jpg"]
    room = make_room(FRAMES, 28, 42, frame_names=[Path(name).stem for name in names])
    for name, image in zip(names, room.images, strict=True):
        (tmp_path / "in" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(image).resize((84, 56)).save(tmp_path / "in" / name)
    source = open_source([tmp_path / "in" / name for name in names])
    export_result(room, tmp_path / "out", form, source=source)
    expected = [name.replace(" ", "_") if form == "colmap-text" else name for name in names]
    if form == "nerfstudio":
        frames = json.loads((tmp_path / "out/transforms.json").read_text())["frames"]
        made = [frame["file_path"].removeprefix("images/") for frame in frames]
    else:
        model = pytest.importorskip("pycolmap").Reconstruction(str(tmp_path / "out/sparse/0"))
        made = [model.images[number].name for number in range(1, FRAMES + 1)]
        assert list(read_views(tmp_path / "out/sparse/0", ".bin" if form == "colmap" else ".txt")) == made
    assert made == expected
    for name, image in zip(made, room.images, strict=True):
        with Image.open(tmp_path / "out/images" / name) as picture:
            assert np.abs(np.asarray(picture.resize((42, 28))).astype(int) - image).mean() < 8
    assert (tmp_path / "out/renamed.csv").exists() == (form == "colmap-text")


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


def test_the_help_names_every_format(capsys):
    print_help("export")
    text = re.sub(r"\s*│\s*", " ", capsys.readouterr().out)
    assert set(re.findall(r"[a-z-]+", text.partition("one of ")[2].partition(".")[0])) == set(FORMATS)


def test_a_repeated_time_keeps_the_rate_of_the_others():
    times = np.arange(12) / 30
    times[5] = times[4]
    np.testing.assert_allclose(frame_times(make_room(12, timestamps=times)), np.arange(13) / 30)


def test_formats_without_pictures_refuse_their_source(tmp_path):
    with pytest.raises(InputError, match="mesh has no pictures, and is made at the model's size; leave --pictures out"):
        check_export(tmp_path / "a.ply", "mesh", pictures=True)
    check_export(tmp_path / "ROOM.PLY", "mesh")


@pytest.mark.parametrize("form", FORMATS)
def test_a_result_without_points_is_not_exported(tmp_path, result, form):
    """Where all moves there is no static point, and without depth none at all; poses and channels need no points."""
    moves = replace(result, dynamic_mask=np.ones_like(result.dynamic_mask))
    empty = replace(result, depth=np.zeros_like(result.depth))
    name = "".join(("a", *FORMATS[form].suffixes[:1]))
    if form in ("colmap", "colmap-text", "gsplat", "nerfstudio"):
        with pytest.raises(InputError, match=f"{form} has the static points .* 100% .* the wrong way round"):
            export_result(moves, tmp_path / name, form)
        unmasked = replace(moves, method="vggt", settings={"masks": "none"})
        with pytest.raises(
            InputError, match=f"{form} has the static points .* none: no pixel that stands still is sure"
        ):
            export_result(unmasked, tmp_path / name, form)
    if form not in ("exr", "tum", "kitti"):
        with pytest.raises(InputError):
            export_result(empty, tmp_path / name, form)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("padded", [False, True])
@pytest.mark.parametrize(
    ("form", "kept", "absent"),
    [
        ("colmap", "masks", ""),
        ("nerfstudio", "masks", ""),
        ("dynamic-splats", "", "mask moving"),
        ("blender", "", "moving"),
    ],
)
def test_a_result_without_a_mask_has_mask_files_for_padding_alone(tmp_path, result, form, kept, absent, padded):
    if form == "colmap":
        pytest.importorskip("pycolmap")
    export_result(result, tmp_path / "masked", form)
    box = np.tile([0, 0, W, H], (FRAMES, 1))
    box[1, 2] -= 6 * padded  # of one frame alone
    nothing = np.zeros_like(result.dynamic_mask)
    vggt = replace(result, method="vggt", dynamic_mask=nothing, settings={"masks": "none"}, valid_box=box)
    export_result(vggt, tmp_path / "out", form)
    for name in (*kept.split(), *absent.split()):
        assert any((tmp_path / "masked" / name).rglob("*.p*"))
        assert (tmp_path / "out" / name).exists() == (padded and name in kept.split())
    if form == "nerfstudio":
        frames = json.loads((tmp_path / "out/transforms.json").read_text())["frames"]
        masks = [frame["mask_path"] for frame in frames if "mask_path" in frame]
        assert [(tmp_path / "out" / name).is_file() for name in masks] == [True] * FRAMES * padded
    if form == "colmap" and padded:
        (path,) = (tmp_path / "out/masks").iterdir()
        assert path.name == "a1.png.png"
        assert not np.asarray(Image.open(path))[:, W - 6 :].any()


def test_names_that_clash_get_their_number_and_lose_their_folder_last():
    assert safe_names(["a?.png", "a*.png", "a_.png", "a__000001.png"]) == [
        *("a__000000.png", "a__000001_0.png"),
        *("a_.png", "a__000001.png"),  # as they are
    ]
    assert safe_names(["a.png", "a.png/b.png", "c/b?.png", "c/b_.png"]) == [
        *("a.png", "a.png_b.png"),  # a folder cannot have the name of a picture
        *("c/b__000002.png", "c/b_.png"),
    ]


def test_pictures_of_relative_and_absolute_paths_and_of_several_drives_have_names(tmp_path, result, monkeypatch):
    for number in range(FRAMES):
        (tmp_path / f"cam{number % 2}").mkdir(exist_ok=True)
        Image.new("RGB", (W, H)).save(tmp_path / f"cam{number % 2}/a{number}.png")
    monkeypatch.chdir(tmp_path)
    paths = [f"cam{number % 2}/a{number}.png" for number in range(FRAMES)]
    source = open_source([paths[0], *(str(tmp_path / path) for path in paths[1:3]), f"cam0/../{paths[3]}"])
    named = replace(result, frame_names=tuple(Path(path).stem for path in paths))
    assert picture_names(named, source) == paths

    def on_two_drives(paths):
        raise ValueError("Paths don't have the same drive")

    monkeypatch.setattr(os.path, "commonpath", on_two_drives)
    assert picture_names(named, source) == [f"a{number}.png" for number in range(FRAMES)]
