import dataclasses
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from tests.shared import generated
from tests.shared.contents import contents
from vggtjax.errors import InputError, OutputError
from vggtjax.interface.commands.scenes import Images, scenes
from vggtjax.research.evaluation.datasets import find_sequences
from vggtjax.storage.trajectories import read_trajectory
from vggtjax.training.scenes import SceneConfig, dataset, generate, textures
from vggtjax.training.scenes.dataset import read_index, write_scenes
from vggtjax.training.scenes.textures import SIDES, Textures, load_textures, sample

S, H, W = 3, 24, 32
CONFIG = SceneConfig(height=H, width=W, frames=S, dynamic=1.0, samples=2)

quick = jax.jit(generate, static_argnums=2, compiler_options=generated.QUICK)


@pytest.fixture(scope="module", autouse=True)
def quickly_compiled():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dataset, "_draw", quick)
        patch.setattr(dataset, "load_textures", {"training": generated.textures()}.__getitem__)
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
    clip = jax.device_get(quick(key, generated.textures(), CONFIG))
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


sampled = jax.jit(sample)

SPLITS = ("training", "test")


def tiles_of(split):
    """The finest level of every tile, [tiles, side, side, 3]."""
    loaded = load_textures(split)
    return np.asarray(loaded.texels)[: loaded.tiles * SIDES[0] ** 2].reshape(loaded.tiles, SIDES[0], SIDES[0], 3)


@pytest.fixture(scope="module")
def tiles():
    return {split: tiles_of(split) for split in SPLITS}


@pytest.fixture(scope="module")
def two_tiles():
    """Two tiles of noise, each level its own noise, and the levels as pictures [tiles, side, side, 3]."""
    generator = np.random.default_rng(3)
    levels = {side: generator.integers(0, 256, (2, side, side, 3), np.uint8) for side in SIDES}
    return Textures(jnp.asarray(np.concatenate([level.reshape(-1, 3) for level in levels.values()]))), levels


def at(textures, u, v, *, footprint=1 / 16, tile=0):
    """Samples [P, 3] at positions u and v of any shape that broadcast."""
    u, v, footprint, tile = (a.ravel() for a in np.broadcast_arrays(u, v, footprint, tile))
    uv = jnp.asarray(np.stack([u, v]), jnp.float32)
    return np.asarray(sampled(textures, jnp.asarray(tile), uv, jnp.asarray(footprint, jnp.float32)).T)


def test_count_of_tiles(tiles):
    for split in SPLITS:
        count = len(textures.PHOTOGRAPHS) * textures.CROPS[split] + textures.PROCEDURAL
        assert load_textures(split).tiles == len(tiles[split]) == count
        assert len({tile.tobytes() for tile in tiles[split]}) == count
    assert not set.intersection(*({tile.tobytes() for tile in tiles[split]} for split in SPLITS))
    np.testing.assert_array_equal(tiles_of("test"), tiles["test"])  # the same every time
    with pytest.raises(InputError, match=r"texture split is 'validation'; expected one of training, test"):
        load_textures("validation")  # type: ignore[arg-type]


def test_crops_come_from_disjoint_columns(tmp_path, monkeypatch):
    """A photograph whose red says the column: every crop shows columns of its own split only."""
    import skimage

    width, height = 500, 300
    column = (255 * (np.arange(width) + 0.5) / width).astype(np.uint8)
    ramp = np.stack(np.broadcast_arrays(column[None], 7, np.arange(height)[:, None] % 256), axis=-1).astype(np.uint8)
    (tmp_path / "data").mkdir()
    Image.fromarray(ramp).save(tmp_path / "data" / "ramp.png")
    monkeypatch.setattr(skimage, "__file__", str(tmp_path / "__init__.py"))
    monkeypatch.setattr(textures, "PHOTOGRAPHS", ("ramp.png",) * 20)
    for split in SPLITS:
        shares = tiles_of(split)[: 20 * textures.CROPS[split], ..., 0] / 255
        low, high = textures.SHARES[split]
        assert low - 0.01 < shares.min() < low + 0.1  # 8 bits and bicubic interpolation are not exact
        assert high - 0.1 < shares.max() < high + 0.01
        assert (np.ptp(shares, axis=(1, 2)) > 0.15).all()


def test_bilinear_samples_by_hand(two_tiles):
    textures, levels = two_tiles
    for tile in (0, 1):
        level = levels[16][tile] / 255  # u = 1 - x and v = 1 - y: the first tile is seen mirrored
        x, y = 3, 7
        on = at(textures, 1 - (x + 0.5) / 16, 1 - (y + 0.5) / 16, tile=tile)[0]
        np.testing.assert_allclose(on, level[y, x], atol=1e-5)
        between = at(textures, 1 - (x + 1) / 16, 1 - (y + 1) / 16, tile=tile)[0]
        np.testing.assert_allclose(between, level[y : y + 2, x : x + 2].mean(axis=(0, 1)), atol=1e-5)
        quarter = at(textures, 1 - (x + 0.75) / 16, 1 - (y + 0.5) / 16, tile=tile)[0]
        np.testing.assert_allclose(quarter, 0.75 * level[y, x] + 0.25 * level[y, x + 1], atol=1e-5)
        corner = at(textures, [0.0, 1.0, 0.99], [0.0, 1.0, 0.99], tile=tile)  # the outer half of a texel is flat
        np.testing.assert_allclose(corner, level[[15, 0, 0], [15, 0, 0]], atol=1e-5)


def test_tiles_repeat_mirrored(two_tiles):
    textures, _ = two_tiles
    u, v = np.random.default_rng(0).random((2, 50))
    first = at(textures, u, v)
    assert np.ptp(first) > 0.3
    for other in ((u + 2, v), (u, v - 4), (-u, v), (u, -v), (2 - u, 2 - v), (6 - u, v)):
        np.testing.assert_allclose(at(textures, *other), first, atol=1e-4)
    assert np.abs(at(textures, u + 1, v) - first).max() > 0.1  # a tile is not its own mirror image
    seam = at(textures, np.array([1 - 1e-4, 1 + 1e-4, -1e-4, 1e-4]), 0.4)
    np.testing.assert_allclose(seam[::2], seam[1::2], atol=1e-5)


def test_the_footprint_picks_the_level(two_tiles):
    textures, levels = two_tiles
    for footprint, side in ((0, 256), (1 / 256, 256), (1 / 128, 128), (1 / 90, 64), (1 / 60, 64), (0.1, 16), (99, 16)):
        x = side // 3
        found = at(textures, 1 - (x + 0.5) / side, 1 - 0.5 / side, footprint=footprint, tile=1)[0]
        np.testing.assert_allclose(found, levels[side][1, 0, x] / 255, atol=2e-3)
