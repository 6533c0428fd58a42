"""Masks that a user brings: names, order, crop and padding, and what the pipeline does with them."""

from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageOps

from tests.shared.seeded import seeded_images
from tests.shared.tiny import tiny_model
from tests.shared.videos import write_video
from vggtjax import load_clip, reconstruct
from vggtjax.clips.masks import MaskWarning, load_masks, masks_at_clip_pixels, read_mask
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


def box(value, background=0, dtype: Any = np.uint8):
    """Return 28 x 56 values with a box, and where the box is."""
    values = np.full((28, 56), background, dtype)
    values[4:12, 8:20] = value
    return values


INSIDE = box(1).astype(bool)


@pytest.mark.parametrize(
    ("values", "ending"),
    [
        (box(3, dtype=np.uint16), "png"),
        (box(3, dtype=np.uint16), "tif"),
        (box(26001, dtype=np.uint16), "png"),  # KITTI's class and object
        (np.maximum(box(3, dtype=np.uint16), np.uint16(40000) * (np.arange(56) == 9) * INSIDE), "png"),
        (box(65535, dtype=np.uint16), "png"),
        (box(70000, dtype=np.int32), "tif"),
    ],
)
def test_numbers_of_objects_in_sixteen_bits(tmp_path, values, ending):
    path = tmp_path / f"a.{ending}"
    Image.fromarray(values).save(path)
    np.testing.assert_array_equal(read_mask(path), INSIDE)


def test_grey_of_sixteen_bits_is_brightness(tmp_path):
    values = box(65535, dtype=np.uint16)
    values[20:] = 9000
    Image.fromarray(values).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "a.png"), INSIDE)


@pytest.mark.parametrize("colour", [(30, 40, 20), (100, 120, 90), (240, 240, 240), (200, 20, 20)])
@pytest.mark.parametrize("behind", [(0, 0, 0, 0), (255, 255, 255, 0), (90, 200, 30, 0)])
@pytest.mark.parametrize("ending", ["png", "webp"])
def test_cut_outs_move_where_they_are_opaque(tmp_path, colour, behind, ending):
    layers = np.full((28, 56, 4), behind, np.uint8)
    layers[INSIDE] = (*colour, 255)
    Image.fromarray(layers).save(tmp_path / f"a.{ending}", lossless=True, exact=True)
    np.testing.assert_array_equal(read_mask(tmp_path / f"a.{ending}"), INSIDE)


def test_masks_with_a_layer_of_opacity(tmp_path):
    mask = box(255)
    for name, alpha, expected in (
        ("opaque", np.full_like(mask, 255), INSIDE),
        ("empty", np.zeros_like(mask), np.zeros_like(INSIDE)),
        ("border", np.where(np.arange(28)[:, None] > 24, 0, 255).astype(np.uint8) + mask * 0, INSIDE),  # warped
    ):
        Image.fromarray(np.dstack([mask, mask, mask, alpha])).save(tmp_path / f"{name}.png")
        np.testing.assert_array_equal(read_mask(tmp_path / f"{name}.png"), expected)
    black = np.zeros_like(mask)
    Image.fromarray(np.dstack([black, black, black, mask])).save(tmp_path / "black.png")
    with pytest.raises(ClipError, match="is black where it is opaque and transparent elsewhere"):
        read_mask(tmp_path / "black.png")


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("of", ["stored", "shown", "exif"])
def test_frames_that_exif_turns(tmp_path, caplog, orientation, of):
    stored = Image.fromarray(box(255))
    tags = Image.Exif()
    tags[0x0112] = orientation
    stored.save(tmp_path / "tagged.png", exif=tags)
    with Image.open(tmp_path / "tagged.png") as tagged:
        shown = ImageOps.exif_transpose(tagged).copy()
    for name in ("frames", "masks"):
        (tmp_path / name).mkdir()
    stored.save(tmp_path / "frames/0.png", exif=tags)
    options: dict[str, Any] = {"exif": tags} if of == "exif" else {}
    (shown if of == "shown" else stored).save(tmp_path / "masks/0.png", **options)
    clip = load_clip(tmp_path / "frames", size=56, mode="pad")
    (found,) = load_masks(tmp_path / "masks", clip)
    ambiguous = orientation in (2, 3, 4)
    if of == "stored" and orientation > 4:
        given = masks_at_clip_pixels(np.asarray(stored)[None] > 127, clip, clip)[0]
        np.testing.assert_array_equal(given, found)
    if not (of == "stored" and ambiguous):  # the shape does not tell
        left, top, right, bottom = clip.valid_box[0]
        np.testing.assert_array_equal(found[top:bottom, left:right], np.asarray(shown) > 127)
    assert bool(caplog.messages) == (ambiguous and of != "exif")


@pytest.mark.parametrize("given", ["folder", "array"])
@pytest.mark.parametrize(("mode", "size"), [("crop", WIDE), ("pad", TALL)])
def test_masks_the_wrong_way_round_are_said(tmp_path, given, mode, size):
    """Of what moves little, the inverted mask moves nearly everywhere; padding does not count."""
    frames = [np.full((*size, 3), 90, np.uint8)] * 3
    right = np.zeros(size, np.uint8)
    right[40:50, 40:60] = 255
    names = ["a.png", "b.png", "c.png"]
    clip = load_clip(str(written(tmp_path / "frames", frames, names)), size=70, patch=14, mode=mode)
    wrong = written(tmp_path / "wrong", [255 - right] * 3, names)
    masks = np.stack([255 - right > 0] * 3)
    advice = "mogrify -negate" if given == "folder" else "give ~masks"
    with pytest.warns(MaskWarning, match=rf"9[5-9]\..% of the pixels move by these masks.*{advice}"):
        masks_at_clip_pixels(wrong if given == "folder" else masks, clip, clip)
    masks_at_clip_pixels(~masks, clip, clip)  # warnings are errors here


@pytest.mark.parametrize(("first", "said"), [(0, False), (1, True), (2, False)])
def test_masks_of_a_video_that_count_from_1_are_said(tmp_path, first, said):
    write_video(tmp_path / "a.mp4", range(6))
    clip = load_clip(str(tmp_path / "a.mp4"), start=3, max_frames=2, size=70, patch=14)
    height, width = clip.source_size[0]
    masks = [np.zeros((height, width), np.uint8)] * 6
    folder = written(tmp_path / "masks", masks, [f"{first + number:06d}.png" for number in range(6)])
    later = load_clip(str(tmp_path / "a.mp4"), start=4, max_frames=2, size=70, patch=14)
    with pytest.warns(MaskWarning, match="000001 is taken for the second picture") if said else nullcontext() as found:
        for part in (clip, later):  # as for windows of a long clip
            load_masks(str(folder), part)
    assert len({str(warning.message) for warning in found or ()}) == said  # one text, which Python says once
