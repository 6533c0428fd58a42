import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from vggtjax.errors import InputError
from vggtjax.training.scenes import textures
from vggtjax.training.scenes.textures import SIDES, Textures, load_textures, sample

quick = jax.jit(sample)

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
    return np.asarray(quick(textures, jnp.asarray(tile), uv, jnp.asarray(footprint, jnp.float32)).T)


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
