"""Data sets of published tables, and lists of frames; each file is made as the page that its comment names has it."""

import io
import json
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.shared.dataset_files import depth_png, npy, opened, picture, png, write
from vggtjax.clips.captures.pictures import picture_size
from vggtjax.clips.media.sampling import Sampling
from vggtjax.errors import InputError
from vggtjax.research.evaluation import mask_scores
from vggtjax.research.evaluation.datasets import find_sequences
from vggtjax.research.evaluation.datasets.frames_list import Pinned, read_frames_list

# A definition file with the lines that a public reader checks: utils/fbms of github.com/achalddave/segment-any-moving.
DEFINITION = (
    "Ground truth definition file; do not change!\n\nTotal number of regions:\n3\n\n{background}\n\n128\n\n255\n\n"
    "Confusion penality matrix\n0 1 1\n1 0 1\n1 1 0\n\nTotal number of frames in this shot:\n4\n"
    "Total number of labeled frames for this shot:\n2\n"
    "Frame number:\n0\nFile name:\n{first}\nInput file name:\ncats01_0001.ppm\n"
    "Frame number:\n3\nFile name:\n{last}\nInput file name:\ncats01_0004.ppm\n"
)


def netpbm(values):
    """A binary .ppm or .pgm (https://netpbm.sourceforge.net/doc/ppm.html)."""
    values = np.asarray(values, np.uint8)
    kind = b"P6" if values.ndim == 3 else b"P5"
    return kind + f"\n{values.shape[1]} {values.shape[0]}\n255\n".encode() + values.tobytes()


def fbms_folder(folder, in_colour):
    """https://lmb.informatik.uni-freiburg.de/resources/datasets: a sequence with its folder GroundTruth."""
    for i in range(4):
        Image.new("RGB", (4, 3)).save(write(folder / f"cats01_{i + 1:04d}.jpg", b""))
    labels = np.array([[0, 0, 128, 128], [0, 255, 255, 7], [0, 0, 0, 0]])  # 7 is no region
    ending, background = ("ppm", 256**3 - 1) if in_colour else ("pgm", 0)
    colours = np.stack([labels * 0, labels * 0, labels], -1)
    colours[labels == 0] = 255
    for i in (1, 4):
        write(folder / f"GroundTruth/cats01_{i:04d}_gt.{ending}", netpbm(colours if in_colour else labels))
    names = {"first": f"cats01_0001_gt.{ending}", "last": f"cats01_0004_gt.{ending}"}
    write(folder / "GroundTruth/cats01Def.dat", DEFINITION.format(background=background, **names))
    return np.isin(labels, (128, 255))


@pytest.mark.parametrize("in_colour", [True, False])
def test_fbms_moves_where_a_region_but_the_background_is(tmp_path, in_colour):
    truth = fbms_folder(tmp_path / "Testset" / "cats01", in_colour)
    (sequence,) = opened("fbms", tmp_path)
    assert (sequence.name, len(sequence)) == ("Testset/cats01", 4)
    masks = [sequence.mask(frame) for frame in range(4)]
    assert masks[1] is masks[2] is None
    assert sequence.left_out[0].usual
    assert mask_scores(np.stack([masks[0], masks[3]]), np.stack([truth] * 2))[:2] == (1, 1)
    definition = tmp_path / "Testset/cats01/GroundTruth/cats01Def.dat"
    write(definition, definition.read_text().replace("cats01_0001_gt", "../../secret"))
    with pytest.raises(InputError, match="expected a path inside"):
        opened("fbms", tmp_path)


def test_segtrack_joins_the_objects(tmp_path):
    """https://web.engr.oregonstate.edu/~lif/SegTrack2/dataset.html: a folder for each of several objects."""
    one, other = np.eye(3, 4, dtype=np.uint8) * 255, np.eye(3, 4, k=1, dtype=np.uint8) * 255
    for name in ("girl", "drift"):
        write(tmp_path / "JPEGImages" / name / "0001.png", picture())
    write(tmp_path / "GroundTruth/girl/0001.png", png(one))
    write(tmp_path / "GroundTruth/drift/1/0001.png", png(one))
    write(tmp_path / "GroundTruth/drift/2/0001.png", png(other))
    drift, girl = opened("segtrack", tmp_path)
    assert np.array_equal(girl.mask(0), one > 0)
    assert np.array_equal(drift.mask(0), (one | other) > 0)
    (tmp_path / "GroundTruth/drift/2/0001.png").unlink()
    with pytest.raises(InputError, match="frame 0001 of sequence drift has no labels"):
        opened("segtrack", tmp_path, sequences=["drift"])


def video_with_tracks(path, frames=5, shift=0.0, spare=0, **changes: Any):
    """https://github.com/google-deepmind/tapnet/tree/main/tapnet/tapvid3d#data-format, as data/construct_po_bench.py of
    St4RTrack writes it: points stand still in the world while the camera moves to the right."""
    jpeg = io.BytesIO()
    Image.new("RGB", (64, 48)).save(jpeg, "JPEG", exif=bytes(spare))
    world = np.array([[0.1, 0, 2], [-0.3, 0.2, 3], [0.5, -0.4, 4]])
    camera = np.tile(np.eye(4), (frames, 1, 1))
    camera[:, 0, 3] = -0.05 * np.arange(frames)
    tracks = world + camera[:, None, :3, 3] + [shift, 0, 0]
    arrays = {
        "images_jpeg_bytes": [jpeg.getvalue()] * frames,
        "tracks_XYZ": tracks.astype(np.float32),
        "visibility": np.ones((frames, 3), bool),
        "fx_fy_cx_cy": np.array([60.0, 60, 32, 24]),
        "extrinsics_w2c": camera,
        "queries_xyt": np.zeros((3, 3)),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    (np.savez if spare else np.savez_compressed)(
        path, **{name: value for name, value in (arrays | changes).items() if value is not None}
    )
    return world


def test_a_video_with_tracks(tmp_path):
    world = video_with_tracks(tmp_path / "po_mini/cab_0.npz", frames=70)
    video_with_tracks(tmp_path / "pstudio_mini/ball_3.npz", 40, spare=30_000, extrinsics_w2c=None)  # more than a MB
    moving, still = opened("worldtrack", tmp_path)
    assert (moving.name, len(moving), len(still)) == ("po_mini/cab_0", 64, 40)  # the first 64 frames
    np.testing.assert_allclose(moving.tracks.points, np.tile(world, (64, 1, 1)), atol=1e-6)
    np.testing.assert_allclose(moving.world_from_camera[3][:3, 3], [0.15, 0, 0])
    assert np.array_equal(still.world_from_camera[4], np.eye(4))
    assert moving.tracks.visible[:5].all()
    assert picture_size(moving.pictures[63]) == (64, 48)
    (every,) = opened("tapvid3d", tmp_path / "po_mini")
    assert len(every) == 70
    assert len(moving.of_frames([2, 3]).tracks.points) == 2


def test_bad_files_of_tracks(tmp_path):
    path = tmp_path / "a.npz"
    cases: tuple[tuple[dict[str, Any], str], ...] = (
        (
            {"shift": 5.0},
            r"track 0 visible at \(185.0, 24.0\) in frame 0, and all its tracks outside the pictures of 64",
        ),
        ({"images_jpeg_bytes": np.array([b"a"] * 5, object)}, "Python objects"),
        ({"tracks_XYZ": np.zeros((5, 2, 3))}, r"tracks_XYZ of shape \(5, 2, 3\); expected \(5, 3, 3\)"),
        ({"visibility": None}, "expected images_jpeg_bytes, tracks_XYZ, visibility, fx_fy_cx_cy"),
        ({"visibility": np.zeros((5, 3), bool)}, "none of 3 tracks is visible"),
    )
    for changes, sentence in cases:
        video_with_tracks(path, **changes)
        with pytest.raises(InputError, match=sentence):
            opened("tapvid3d", tmp_path)


def test_spatialbench(tmp_path):
    """https://github.com/Ropedia/SpatialBench, benchmark/README.md, "Per-scene Layout"."""
    for scene, dynamics in (("droid/Fri/18026681", "dynamic"), ("tum/desk/0", "static")):
        folder = tmp_path / "sparse" / scene
        for i, name in enumerate(("000007", "000031")):
            write(folder / f"images/{name}.png", picture())
            write(folder / f"depths/{name}.png", depth_png([[0, 500, 900 + i, 1100]] * 3))
            write(folder / f"depth_masks/{name}.png", png(np.array([[255, 0, 255, 255]] * 3, np.uint8)))
            write(folder / f"poses/{name}.npy", npy(np.column_stack([np.eye(3), [i, 0, 0]])))
        write(folder / "intrinsics/intrinsic.npy", npy(np.array([[8.0, 0, 1.5], [0, 8, 1], [0, 0, 1]])))
        meta = {"depth_format": "uint16_png_div1000", "intrinsic_mode": "shared", "tags": {"dynamics": dynamics}}
        write(folder / "meta.json", json.dumps(meta))
    robot, desk = opened("spatialbench", tmp_path)
    assert (robot.name, len(robot)) == ("sparse/droid/Fri/18026681", 2)
    np.testing.assert_allclose(robot.depth(1), [[0, 0, 0.901, 0]] * 3)  # masked; farther than a metre
    np.testing.assert_allclose(desk.depth(1), [[0, 0, 0.901, 1.1]] * 3)
    assert robot.world_from_camera[1][0, 3] == 1
    assert robot.intrinsics[0].tolist() == [[8, 0, 2], [0, 8, 1.5], [0, 0, 1]]
    assert [sequence.name for sequence in opened("spatialbench-dynamic", tmp_path)] == [robot.name]
    with pytest.raises(InputError, match=r"none of 1 scenes below .* has the tag dynamics: dynamic"):
        opened("spatialbench-dynamic", tmp_path / "sparse/tum")
    write(folder / "meta.json", json.dumps(meta | {"depth_format": "lidar"}))
    with pytest.raises(InputError, match="depth_format 'lidar'; expected one of uint16_png_div1000"):
        opened("spatialbench", tmp_path / "sparse/tum")


def test_lists_of_frames(tmp_path):
    """https://github.com/yyfz/Pi3/tree/evaluation/datasets: seq-id-maps/*.json and sequences/*.txt."""
    for name in ("walk", "run"):
        for i in range(12):
            write(tmp_path / "data" / name / f"rgb/{i:02d}.png", picture())
    pinned, drawn = tmp_path / "map.json", tmp_path / "list.txt"
    write(pinned, json.dumps({"walk": [7, 2, 11]}))
    write(drawn, "walk 01 00\nrun\n")
    (walk,) = opened("plain", tmp_path / "data", frames_list=pinned)
    assert [path.stem for path in walk.pictures] == ["07", "02", "11"]  # in the order of the list
    walk, run = opened("plain", tmp_path / "data", frames_list=drawn, frames_seed=4)
    assert [path.stem for path in walk.pictures] == ["01", "00"]
    expected = np.random.RandomState(4).choice(12, 10, replace=False)
    assert [int(path.stem) for path in run.pictures] == expected.tolist()
    assert [len(each) for each in opened("plain", tmp_path / "data", frames_seed=0)] == [10, 10]
    assert read_frames_list(drawn, 3)["run"] == Pinned((), 3, str(drawn))

    cases: tuple[tuple[str, dict[str, Any], str], ...] = (
        ('{"walk": [3, 12]}', {}, "names frame 12 of sequence walk, which has 12 frames, 00 to 11; get the sequence"),
        ('{"jump": [1]}', {}, "sequence 'jump' of plain is not in"),
        ('{"walk": [1]}', {"sequences": ["run"]}, "has no frames of sequence run; add a line"),
        ('{"walk": [1, 1]}', {}, "for sequence walk; expected a list of numbers or names of frames, each once"),
        ("", {}, "lists no sequence; expected a JSON object"),
        ('{"walk": [1]}', {"sampling": Sampling(stride=2)}, "excludes start, stride, max_frames and skip"),
    )
    for content, options, sentence in cases:
        write(pinned, content)
        with pytest.raises(InputError, match=sentence):
            find_sequences("plain", tmp_path / "data", frames_list=pinned, **options)
    for i in (9, 10, 11):
        (tmp_path / f"data/run/rgb/{i:02d}.png").unlink()
    with pytest.raises(InputError, match="sequence run has 9 frames; expected 10 or more to draw from"):
        find_sequences("plain", tmp_path / "data", frames_seed=0)
