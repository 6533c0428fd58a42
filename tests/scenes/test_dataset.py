import dataclasses
import json
import re
import shutil
import subprocess
import sys
from typing import Any

import jax
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.generated import QUICK, textures
from vggtjax.clips.clip import load_clip
from vggtjax.commands.scenes import Images, scenes
from vggtjax.errors import InputError, OutputError
from vggtjax.evaluation.datasets import find_sequences
from vggtjax.scenes import SceneConfig, dataset, generate
from vggtjax.scenes.dataset import read_index, write_scenes
from vggtjax.scenes.sheet import color_flow, color_parts, draw_sheet

S, H, W = 3, 24, 32
CONFIG = SceneConfig(height=H, width=W, frames=S, dynamic=1.0, samples=2)
FILES = {
    "trajectory.txt",
    "intrinsics.txt",
    "part_poses.npy",
    *(
        f"{name}/{frame:05d}.{ending}"
        for frame in range(S)
        for name, ending in (
            ("images", "png"),
            ("depth", "npy"),
            ("depth", "png"),
            ("mask", "png"),
            ("parts", "png"),
            ("flow", "npy"),
        )
    ),
}

quick = jax.jit(generate, static_argnums=2, compiler_options=QUICK)


@pytest.fixture(autouse=True)
def quickly_compiled(monkeypatch):
    monkeypatch.setattr(dataset, "_draw", quick)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A set of two scenes, by the command."""
    out = tmp_path_factory.mktemp("sets") / "new" / "set"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dataset, "_draw", quick)
        scenes(out, count=2, images=Images(frames=S, height=H, width=W), seed=3)
    return out


def test_an_evaluation_reads_the_set(written):
    (first, _) = find_sequences("plain", written).values()
    sequence: Any = first()  # with depth, masks and cameras
    depth = np.load(written / "scene_0000/depth/00001.npy")
    assert (len(sequence), sequence.notes) == (S, ())
    assert np.allclose(sequence.depth(1), depth, atol=1e-3)
    assert sequence.mask(1).shape == (H, W)
    assert np.allclose(sequence.intrinsics[:, [0, 1], 2], [W / 2, H / 2])
    assert np.abs(np.diff(sequence.world_from_camera[:, :3, 3], axis=0)).max() > 0


def files(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def arrays(scene, name, ending="png"):
    """The frames of a scene's folder, [S, ...]."""
    paths = sorted((scene / name).glob(f"*.{ending}"))
    if ending == "npy":
        return np.stack([np.load(path, allow_pickle=False) for path in paths])
    return np.stack([np.asarray(Image.open(path)) for path in paths])


def test_files_and_nothing_else(written):
    assert {path.name for path in written.iterdir()} == {"index.json", "preview.png", "scene_0000", "scene_0001"}
    for name in ("scene_0000", "scene_0001"):
        assert set(files(written / name)) == FILES


def test_every_file_says_what_the_renderer_said(written):
    """The scene is drawn again from what index.json says."""
    index = read_index(written)
    config = json.loads(json.dumps(dataclasses.asdict(CONFIG)))
    assert index["config"] | {"pitch": [0, 0], "roll": 0} == config  # fields that older sets lack are left out
    assert (index["kind"], index["split"], index["seed"]) == ("dynamic", "training", 3)
    recipe = re.fullmatch(r"scene n is generate\(fold_in\(fold_in\(key\(3\), (\d+)\), n\), .*", index["key"])
    assert recipe
    stream = int(recipe[1])
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(3), stream), 1)
    clip = jax.device_get(quick(key, textures(), CONFIG))
    scene = written / "scene_0001"

    np.testing.assert_array_equal(arrays(scene, "images"), np.rint(255 * clip.images))
    np.testing.assert_array_equal(arrays(scene, "depth", "npy"), clip.depth)
    millimetres = arrays(scene, "depth")
    assert millimetres.dtype == np.uint16
    np.testing.assert_allclose(millimetres / 1000, clip.depth, atol=5.1e-4)
    np.testing.assert_array_equal(arrays(scene, "mask"), 255 * clip.dynamic_mask)
    np.testing.assert_array_equal(arrays(scene, "parts"), clip.part_ids)
    np.testing.assert_array_equal(np.array(index["objects"])[arrays(scene, "parts")], clip.object_ids)
    np.testing.assert_array_equal(arrays(scene, "flow", "npy"), clip.scene_flow)
    np.testing.assert_array_equal(np.load(scene / "part_poses.npy", allow_pickle=False), clip.world_from_part)
    assert arrays(scene, "flow", "npy").dtype == arrays(scene, "depth", "npy").dtype == np.float32

    focal, _, x, y = np.loadtxt(scene / "intrinsics.txt").T
    np.testing.assert_allclose(focal, clip.intrinsics[:, 0, 0], rtol=1e-6)
    assert (x == W / 2).all()
    assert (y == H / 2).all()


def test_the_files_alone_carry_points_from_frame_to_frame(written):
    """The conventions that index.json states: poses, intrinsics, depth and parts give the flow."""
    for scene in (written / "scene_0000", written / "scene_0001"):
        trajectory = np.loadtxt(scene / "trajectory.txt")
        np.testing.assert_array_equal(trajectory[:, 0], np.arange(S))
        fx, fy, cx, cy = np.loadtxt(scene / "intrinsics.txt")[0]
        depth, parts = arrays(scene, "depth", "npy"), arrays(scene, "parts")
        poses = np.load(scene / "part_poses.npy", allow_pickle=False).astype(np.float64)
        y, x = np.mgrid[0:H, 0:W] + 0.5
        for frame in range(S - 1):
            seen = depth[frame, ..., None] * np.stack([(x - cx) / fx, (y - cy) / fy, np.ones((H, W))], axis=-1)
            world = seen @ Rotation.from_quat(trajectory[frame, 4:]).as_matrix().T + trajectory[frame, 1:4]
            before, after = poses[frame, parts[frame]], poses[frame + 1, parts[frame]]  # [H, W, 3, 4]
            local = np.einsum("hwji,hwj->hwi", before[..., :3], world - before[..., 3])
            moved = np.einsum("hwij,hwj->hwi", after[..., :3], local) + after[..., 3]
            np.testing.assert_allclose(world + arrays(scene, "flow", "npy")[frame], moved, atol=2e-5)


def test_images_load_as_a_clip(written):
    clip = load_clip(written / "scene_0000" / "images", size=28, patch=14)
    assert clip.frame_names == ["00000", "00001", "00002"]
    assert clip.images.shape == (S, 28, 28, 3)
    assert clip.timestamps is None


def test_the_preview_shows_every_scene(written):
    with Image.open(written / "preview.png") as picture:
        assert picture.mode == "RGB"
        width, height = picture.size
    assert width > 7 * 200
    assert height > 2 * 190
    one = draw_sheet([written / "scene_0000"], "one scene")
    assert one.size[0] == width
    assert one.size[1] < height - 190


def test_colours_by_hand():
    parts = color_parts(np.array([[0, 1, 2, 1]]))
    assert (parts[0, 1] == parts[0, 3]).all()
    assert len({tuple(colour) for colour in parts[0]}) == 3
    flow = np.zeros((1, 3, 3))
    flow[0, 1], flow[0, 2] = (2, 0, -1), (-2, 0, 0)
    assert color_flow(flow).tolist() == [[list(parts[0, 0]), [255, 128, 64], [0, 128, 128]]]
    assert (color_flow(np.zeros((2, 2, 3))) == parts[0, 0]).all()


def test_a_set_goes_on_where_it_stopped(written, tmp_path, monkeypatch):
    out, calls = tmp_path / "set", []

    def failing(folder, *arguments):
        calls.append(arguments)
        if len(calls) > S:
            raise OSError(28, "No space left on device")
        return write_frame(folder, *arguments)

    write_frame = dataset._write_frame
    monkeypatch.setattr(dataset, "_write_frame", failing)
    with pytest.raises(OutputError, match="No space left on device"):
        write_scenes(out, CONFIG, count=2, seed=3)
    assert {path.name for path in out.iterdir()} == {"index.json", "scene_0000"}
    assert read_index(out)["scenes"] == ["scene_0000"]

    monkeypatch.setattr(dataset, "_write_frame", write_frame)
    kept = (out / "scene_0000").stat()
    progress = []
    folders = write_scenes(out, CONFIG, count=2, seed=3, progress=lambda *call: progress.append(call))
    assert progress == [(1, 2), (2, 2)]
    assert folders == [out / "scene_0000", out / "scene_0001"]
    assert (out / "scene_0000").stat().st_mtime_ns == kept.st_mtime_ns
    assert files(out) == files(written)  # as if it had never stopped


def test_fewer_scenes_keep_those_that_are_there(written, tmp_path):
    before, copy = files(written), tmp_path / "set"
    shutil.copytree(written, copy)
    assert write_scenes(copy, CONFIG, count=1, seed=3) == [copy / "scene_0000"]
    after = files(copy)
    assert read_index(copy)["scenes"] == ["scene_0000", "scene_0001"]
    assert {name: after[name] for name in before if name != "preview.png"} == {
        name: before[name] for name in before if name != "preview.png"
    }


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"seed": 4}, "holds scenes with seed 3 instead of 4; choose another folder"),
        ({"kind": "static"}, "kind 'dynamic' instead of 'static'"),
        ({"split": "test"}, "split 'training' instead of 'test'"),
        ({"config": dataclasses.replace(CONFIG, width=40)}, "with width of config 32 instead of 40; choose"),
        ({"config": dataclasses.replace(CONFIG, roll=9)}, "with roll of config 0.0 instead of 9.0; choose"),
    ],
)
def test_sets_of_other_settings_are_not_mixed(written, changes, says):
    before = files(written)
    with pytest.raises(InputError, match=says):
        write_scenes(written, **({"config": CONFIG, "count": 3, "seed": 3} | changes))
    assert files(written) == before


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"count": 0}, "count is 0; expected a whole number from 1 to 10000"),
        ({"count": 10_001}, "count is 10001"),
        ({"kind": "moving"}, "kind is 'moving'; expected one of"),
        ({"split": "validation"}, "split is 'validation'; expected one of"),
        ({"seed": -1}, "seed is -1; expected a whole number in"),
        ({"seed": 2**31}, "seed is 2147483648"),
        ({"images": Images(frames=0)}, "frames is 0"),
        ({"images": Images(shutter=0.5)}, "shutter is 0.5 with 1 exposures; motion blur needs"),
        ({"images": Images(exposures=4)}, "shutter is 0.0 with 4 exposures"),
    ],
)
def test_bad_input_is_one_sentence_before_anything_is_drawn(tmp_path, monkeypatch, changes, says):
    monkeypatch.setattr(dataset, "_draw", None)
    with pytest.raises(InputError, match=says):
        scenes(tmp_path / "set", **changes)
    assert not (tmp_path / "set").exists()


def test_other_peoples_files_are_not_touched(tmp_path, monkeypatch):
    monkeypatch.setattr(dataset, "_draw", None)
    (tmp_path / "scene_0004").mkdir()
    with pytest.raises(OutputError, match=r"scene_0004 exists without index.json beside it"):
        write_scenes(tmp_path, CONFIG, count=1)
    for text, says in (
        ("{", "is not JSON that can be read"),
        ("[" * 100_000, "is not JSON that can be read"),
        ('["vggtjax scenes"]', r"index of scenes .*; expected an object"),
        ('{"format": "vggtjax scenes", "version": 2}', "has version 2; expected 1"),
        (" " * (dataset._INDEX_BYTES + 1), "has more than 4194304 bytes"),
    ):
        (tmp_path / "index.json").write_text(text)
        with pytest.raises(InputError, match=says):
            write_scenes(tmp_path, CONFIG, count=1)
        assert (tmp_path / "index.json").read_text() == text
    with pytest.raises(OutputError, match="cannot write"):
        write_scenes(tmp_path / "index.json", CONFIG, count=1)
    with pytest.raises(InputError, match=r"cannot read .*index.json"):
        read_index(tmp_path / "scene_0004")


def test_the_command_does_not_import_jax_before_it_runs():
    code = "import sys; import vggtjax.commands.scenes; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
