"""Cells and matches of pixels by hand: depth at a cell's centre, windows at padding and at the rim of the picture."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from vggtjax.method.matching.matches import frame_pairs, patch_centres
from vggtjax.pipeline.refinement.cells import cells_of
from vggtjax.pipeline.refinement.pixel_mask import _difference
from vggtjax.pipeline.refinement.pixel_matches import PixelMatches, Window, match_pixels
from vggtjax.results.reconstruction import Reconstruction

GRID, SIDE, FRAMES = (8, 10), 8, 3


def result_of(depth):
    """Return a result with this depth, of pictures of its size."""
    S, H, W = depth.shape
    return Reconstruction(
        depth=depth,
        depth_confidence=np.ones_like(depth),
        saliency=None,
        dynamic_mask=np.zeros(depth.shape, bool),
        camera_from_world=np.tile(np.eye(3, 4, dtype=np.float32), (S, 1, 1)),
        intrinsics=np.tile(np.array([[W, 0, W / 2], [0, W, H / 2], [0, 0, 1]], np.float32), (S, 1, 1)),
        images=np.zeros((S, H, W, 3), np.uint8),
        frame_names=tuple("abc"),
        timestamps=None,
        method="vggt",
        model_name="none",
        settings={},
        source_size=np.tile([H, W], (S, 1)),
        source_scale=np.ones((S, 2)),
        source_offset=np.zeros((S, 2)),
        valid_box=np.tile([0, 0, W, H], (S, 1)),
    )


@pytest.mark.parametrize(("height", "width"), [(96, 96), (84, 160), (75, 160)])
def test_the_depth_of_a_cell_is_that_of_its_centre(height, width):
    """Cells are 4 pixels, or not whole ones. The clip of the four pixels costs a pixel of the flatter slope, 0.3 %."""
    y, x = np.mgrid[:height, :width] + 0.5
    depth = np.broadcast_to(np.exp(0.01 * y + 0.003 * x), (3, height, width)).astype(np.float32)
    cells = cells_of(result_of(depth))
    rows, columns = cells.grid
    centres = patch_centres(cells.grid) * [width / columns, height / rows]
    np.testing.assert_allclose(cells.depth[0], np.exp(centres @ [0.003, 0.01]), rtol=0.003)


@pytest.fixture(scope="module")
def pictures():
    """A texture that goes by two pixels to the left in each frame."""
    noise = np.random.default_rng(0).random((GRID[0] * SIDE, GRID[1] * SIDE + 2 * FRAMES))
    texture = gaussian_filter(noise, 1.5)
    texture = (texture - texture.min()) / np.ptp(texture)
    return np.stack([texture[:, 2 * s : 2 * s + GRID[1] * SIDE] for s in range(FRAMES)]).astype(np.float32)


def matches(pictures, shown=None, *, strict=False):
    pairs = frame_pairs(FRAMES)
    shape = (*pairs.others.shape, GRID[0] * GRID[1])
    expected = np.broadcast_to(patch_centres(GRID), (*shape, 2)).astype(np.float32)
    warp = np.broadcast_to(np.eye(2, dtype=np.float32), (*shape, 2, 2))
    return match_pixels(pictures, expected, warp, GRID, Window(3, 5), shown, strict=strict), pairs


def test_windows_that_leave_the_picture_move_no_match(pictures):
    found, pairs = matches(pictures, strict=True)
    true = patch_centres(GRID) - np.array([2 / SIDE, 0]) * np.array(pairs.offsets)[:, None, None]
    sure = found.weight > 0.5
    assert sure.mean() > 0.3
    off = np.abs(found.position - true[None])[sure] * SIDE
    assert off.max() < 0.3  # pixels
    loose, _ = matches(pictures)
    assert np.abs(loose.position - true[None])[loose.weight > 0.5].max() * SIDE > 0.3


def test_padding_matches_nothing(pictures):
    """The upper quarter is padding: its rim stands where the picture goes by."""
    padded, top = pictures.copy(), 2 * SIDE + 3
    padded[:, :top] = 0.5
    shown = np.tile(np.array([-np.inf, top / SIDE, np.inf, np.inf], np.float32), (FRAMES, 1))
    found, _ = matches(padded, shown)
    rows = np.arange(GRID[0] * GRID[1]) // GRID[1]
    assert not found.weight[:, :, rows < 3].any()
    assert (found.weight[:, :, rows > 3].max(axis=(0, 1)) > 0.5).all()
    without, _ = matches(padded)
    assert without.weight[:, :, rows == 2].any()


def test_cells_without_matches_differ_as_a_quiet_one_of_the_others():
    position = np.zeros((1, 1, 5, 2), np.float32)
    position[0, 0, :, 0] = [1, 2, 3, 9, 9]
    weight = np.array([[[1, 1, 1, 0, 0]]], np.float32)
    found = _difference(np.zeros_like(position), PixelMatches(position, weight))
    np.testing.assert_allclose(found, [[0.5, 1, 1.5, 0.75, 0.75]])
