import dataclasses
import re
from typing import Any

import jax
import numpy as np
import pytest
from PIL import Image

from tests.shared.contents import contents
from tests.shared.generated import QUICK, textures
from vggtjax.errors import InputError, OutputError
from vggtjax.interface.commands.scenes import Images, scenes
from vggtjax.research.evaluation.datasets import find_sequences
from vggtjax.storage.trajectories import read_trajectory
from vggtjax.training.scenes import SceneConfig, dataset, generate
from vggtjax.training.scenes.dataset import read_index, write_scenes

S, H, W = 3, 24, 32
CONFIG = SceneConfig(height=H, width=W, frames=S, dynamic=1.0, samples=2)

quick = jax.jit(generate, static_argnums=2, compiler_options=QUICK)


@pytest.fixture(scope="module", autouse=True)
def quickly_compiled():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dataset, "_draw", quick)
        patch.setattr(dataset, "load_textures", {"training": textures()}.__getitem__)
        yield


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A set of two scenes, by the command."""
    out = tmp_path_factory.mktemp("sets") / "new" / "set"
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


def arrays(scene, name, ending="png"):
    """The frames of a scene's folder, [S, ...]."""
    paths = sorted((scene / name).glob(f"*.{ending}"))
    if ending == "npy":
        return np.stack([np.load(path, allow_pickle=False) for path in paths])
    return np.stack([np.asarray(Image.open(path)) for path in paths])


def test_every_file_says_what_the_renderer_said(written):
    """The scene is drawn again from what index.json says."""
    index = read_index(written)
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
    np.testing.assert_array_equal(arrays(scene, "flow", "npy"), clip.scene_flow)
    np.testing.assert_array_equal(np.load(scene / "part_poses.npy", allow_pickle=False), clip.world_from_part)
    _, poses = read_trajectory(scene / "trajectory.txt")
    np.testing.assert_allclose(np.linalg.inv(poses)[:, :3], clip.camera_from_world, atol=1e-5)
    np.testing.assert_allclose(np.loadtxt(scene / "intrinsics.txt")[:, 0], clip.intrinsics[:, 0, 0], rtol=1e-6)


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
    assert contents(out) == contents(written)  # as if it had never stopped


def test_sets_of_other_settings_are_not_mixed(written):
    before = contents(written)
    with pytest.raises(InputError, match="holds scenes with seed 3 instead of 4; choose another folder"):
        write_scenes(written, CONFIG, count=3, seed=4)
    with pytest.raises(InputError, match=r"with roll of config 0.0 instead of 9.0; choose"):
        write_scenes(written, dataclasses.replace(CONFIG, roll=9), count=3, seed=3)
    assert contents(written) == before


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"seed": 2**31}, "seed is 2147483648"),
        ({"images": Images(shutter=0.5)}, "shutter is 0.5 with 1 exposures; motion blur needs"),
    ],
)
def test_bad_input_is_one_sentence_before_anything_is_drawn(tmp_path, monkeypatch, changes, says):
    monkeypatch.setattr(dataset, "_draw", None)
    with pytest.raises(InputError, match=says):
        scenes(tmp_path / "set", **changes)
    assert not (tmp_path / "set").exists()


def test_other_peoples_files_are_not_touched(tmp_path, monkeypatch):
    monkeypatch.setattr(dataset, "load_textures", lambda split: None)
    (tmp_path / "scene_0004").mkdir()
    with pytest.raises(OutputError, match=r"scene_0004 exists without index.json beside it"):
        write_scenes(tmp_path, CONFIG, count=1)
    for text, says in (
        ('{"format": "vggtjax scenes", "version": 2}', "has version 2; expected 1"),
        (" " * (dataset._INDEX_BYTES + 1), "has more than 4194304 bytes"),
    ):
        (tmp_path / "index.json").write_text(text)
        with pytest.raises(InputError, match=says):
            write_scenes(tmp_path, CONFIG, count=1)
        assert (tmp_path / "index.json").read_text() == text
