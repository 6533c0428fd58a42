"""Masks that a user brings: names, order, crop and padding, and what the pipeline does with them."""

import numpy as np
import pytest
from PIL import Image

from testing.seeded import seeded_images
from tests.tiny import tiny_model
from vggtjax import load_clip, reconstruct
from vggtjax.clips.masks import load_masks, masks_at_clip_pixels
from vggtjax.errors import ClipError, InputError

WIDE, TALL = (90, 160), (160, 90)  # height, width


def written(folder, pictures, names):
    folder.mkdir()
    for picture, name in zip(pictures, names, strict=True):
        Image.fromarray(picture).save(folder / name)
    return folder


def pictures(count, size, generator) -> list[np.ndarray]:
    """Frames that are white in a box and black elsewhere, so that a frame is its own mask."""
    found = []
    for _ in range(count):
        frame = np.zeros((*size, 3), np.uint8)
        top, left = generator.integers(5, size[0] // 2), generator.integers(5, size[1] // 2)
        frame[top : top + size[0] // 3, left : left + size[1] // 3] = 255
        found.append(frame)
    return found


@pytest.mark.parametrize(("size", "mode"), [(TALL, "crop"), (WIDE, "pad")])
def test_masks_land_where_the_frames_do(tmp_path, size, mode):
    frames = pictures(3, size, np.random.default_rng(0))
    names = ["a_10.png", "a_2.png", "a_1.png"]
    clip = load_clip(str(written(tmp_path / "frames", frames, names)), size=70, patch=14, mode=mode)
    masks = load_masks(written(tmp_path / "masks", [f[..., 0] for f in frames], names), clip)
    bright = clip.images.mean(axis=-1) > 0.5
    for mask, frame, (left, top, right, bottom) in zip(masks, bright, clip.valid_box, strict=True):
        assert (mask[top:bottom, left:right] == frame[top:bottom, left:right]).mean() > 0.97
        mask = mask.copy()
        mask[top:bottom, left:right] = False
        assert not mask.any()


def test_masks_at_the_size_of_the_loaded_clip_are_refitted():
    frames = np.stack(pictures(2, TALL, np.random.default_rng(1)))
    loaded = load_clip(frames, size=140, mode="pad")
    clip = loaded.refit(70, 14)
    masks = masks_at_clip_pixels(loaded.images.mean(axis=-1) > 0.5, clip, loaded)
    left, top, right, bottom = clip.valid_box[0]
    bright = np.zeros(clip.images.shape[:3], bool)
    bright[:, top:bottom, left:right] = clip.images[:, top:bottom, left:right].mean(axis=-1) > 0.5
    assert (masks == bright).mean() > 0.97
    with pytest.raises(InputError, match="expected bool"):
        masks_at_clip_pixels(masks[:, 1:], clip, loaded)


def test_palettes_are_labels_and_transparency_is_static(tmp_path):
    frames = pictures(2, WIDE, np.random.default_rng(3))
    clip = load_clip(np.stack(frames), size=70, patch=14)
    bright = clip.images.mean(axis=-1) > 0.5
    (tmp_path / "palette").mkdir()
    (tmp_path / "clear").mkdir()
    for i, frame in enumerate(frames):
        labels = Image.fromarray((frame[..., 0] > 0).astype(np.uint8) * 8, mode="P")
        labels.putpalette([0] * 24 + [64, 0, 0] + [0] * 741)  # object 8 of DAVIS is nearly black
        labels.save(tmp_path / f"palette/{i}.png")
        Image.fromarray(np.dstack([np.full_like(frame, 255), frame[..., :1]])).save(tmp_path / f"clear/{i}.png")
    for folder in ("palette", "clear"):
        assert (load_masks(tmp_path / folder, clip) == bright).mean() > 0.97


def test_masks_that_do_not_fit(tmp_path):
    frames = pictures(2, WIDE, np.random.default_rng(4))
    clip = load_clip(str(written(tmp_path / "frames", frames, ["00.png", "01.png"])), size=70, patch=14)
    flat = [frame[..., 0] for frame in frames]
    halves = written(tmp_path / "halves", [mask[::2, ::2] for mask in flat], ["00.png", "01.png"])
    assert (load_masks(halves, clip) == (clip.images.mean(axis=-1) > 0.5)).mean() > 0.95
    for name, masks, names, words in (
        ("one", flat[:1], ["x.png"], "1 pictures for 2 frames"),
        ("turned", [mask.T for mask in flat], ["00.png", "01.png"], "expected the same shape"),
        ("shifted", flat, ["01.png", "02.png"], "none is named 00"),
        ("twice", [*flat, flat[0]], ["00.png", "01.png", "00.bmp"], "2 pictures named 00"),
        ("dark", [mask // 255 for mask in flat], ["00.png", "01.png"], "1 of 255 at its brightest"),
    ):
        with pytest.raises(ClipError, match=words):
            load_masks(written(tmp_path / name, masks, names), clip)


@pytest.mark.filterwarnings("ignore:the field of view")  # seeded weights give odd cameras
def test_given_masks_replace_the_mined_ones():
    clip, model = load_clip(seeded_images(3, 56, 56, seed=4).transpose(0, 2, 3, 1), size=56), tiny_model()
    masks = np.zeros(clip.images.shape[:3], bool)
    masks[:, 10:30, 20:40] = True
    made = reconstruct(model, clip, size=56, masks=masks, keep_passes=True)
    assert np.array_equal(made.dynamic_mask, masks)
    assert made.settings["masks"] == "given"
    still = reconstruct(model, clip, size=56, masks=np.zeros_like(masks), keep_passes=True)
    assert np.array_equal(still.passes.first.depth, still.passes.second.depth)
    assert np.allclose(still.depth, still.passes.first.depth[0], rtol=1e-5)
    assert np.abs(made.passes.first.depth - still.passes.first.depth).max() < 1e-5  # of another program
    assert not np.allclose(made.camera_from_world, still.camera_from_world, atol=1e-4)
    with pytest.raises(InputError, match="expected bool"):
        reconstruct(model, clip, size=56, masks=masks[:2])
