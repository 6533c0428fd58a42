"""Metric scale: by folders of depth maps as depth models and lidars write them, by single depths, or a baseline."""

from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.shared.room import make_room
from vggtjax.errors import InputError
from vggtjax.pipeline.known.apply import apply_known, scaled
from vggtjax.pipeline.known.depth_maps import read_depth_maps
from vggtjax.pipeline.known.given import check_readable, read_known
from vggtjax.pipeline.known.options import KnownGeometry

TRUE = make_room(frames=4, height=56, width=84, frame_names=("a0", "a1", "a2", "a10"))
SMALL = scaled(TRUE, 0.25)


def depth_pro(path, depth):
    np.savez_compressed(path.with_suffix(".npz"), depth=depth)
    Image.new("RGB", depth.shape[::-1]).save(path.with_suffix(".jpg"))  # its picture of the map


def unidepth(path, depth):
    np.save(path.with_suffix(".npy"), depth[None, None].astype(np.float32))


def kitti(path, depth):
    Image.fromarray(np.nan_to_num(256 * depth, posinf=0).round().astype(np.uint16)).save(path.with_suffix(".png"))


def write(folder, writer, depths, names=TRUE.frame_names):
    folder.mkdir(exist_ok=True)
    for name, depth in zip(names, depths, strict=True):
        writer(folder / name, depth)
    return str(folder)


def spoilt(depth, share=0.3, noise=0.1):
    """Depth with noise, a share of outliers that are all too far, and holes of every kind in a fifth of the rest."""
    rng = np.random.default_rng(1)
    made = depth * np.exp(noise * rng.standard_normal(depth.shape))
    kind = rng.random(depth.shape)
    made = np.where(kind < share, made * rng.uniform(2, 20, depth.shape), made)
    holes = rng.choice([0.0, np.nan, np.inf, -1.0], depth.shape)
    return np.where(kind > share + 0.8 * (1 - share), holes, made)


@pytest.mark.parametrize(
    ("writer", "larger", "per_metre"), [(depth_pro, 2, None), (unidepth, 1, None), (kitti, 3, 256.0)]
)
def test_layouts_of_public_models_at_their_own_size(tmp_path, writer, larger, per_metre):
    depths = TRUE.depth.repeat(larger, axis=1).repeat(larger, axis=2)
    depths[0, :5] = 0  # unknown
    folder = write(tmp_path / "maps", writer, depths)
    maps = read_depth_maps(tmp_path / "maps", TRUE, per_metre)
    np.testing.assert_allclose(maps[1:], TRUE.depth[1:], atol=1 / 256 if per_metre else 1e-6)
    known = KnownGeometry(known_depths=folder, depths_per_metre=per_metre)
    check_readable(known)
    found, unit = apply_known(SMALL, read_known(known, SMALL))
    assert unit == pytest.approx(4, rel=1e-3)
    assert found.length_unit == "metre"
    np.testing.assert_allclose(found.depth, TRUE.depth, rtol=1e-3)


def test_a_third_of_outliers_and_holes_do_not_move_a_robust_fit(tmp_path):
    folder = write(tmp_path / "maps", depth_pro, spoilt(TRUE.depth))
    median = apply_known(SMALL, read_known(KnownGeometry(known_depths=folder), SMALL))[1]
    known = KnownGeometry(known_depths=folder, robust=True)
    found, robust = apply_known(SMALL, read_known(known, SMALL))
    assert median > 4 * 1.04  # which 30 % of outliers on one side move by 0.55 deviations of 10 %
    assert robust == pytest.approx(4, rel=0.01)
    assert found.settings["known"]["robust"] is True
    said = found.known_facts["scale"]
    assert said.endswith("% of them are outliers, which do not count")
    assert 30 <= int(said.split("; ")[-1].split("%")[0]) <= 37  # 30 of the 86 % that are known
    clean = write(tmp_path / "clean", unidepth, TRUE.depth)
    assert apply_known(SMALL, read_known(KnownGeometry(known_depths=clean, robust=True), SMALL))[1] == pytest.approx(4)


def test_maps_are_matched_by_name_or_else_in_order(tmp_path):
    some = write(tmp_path / "some", unidepth, TRUE.depth[2:], TRUE.frame_names[2:])
    maps = read_depth_maps(tmp_path / "some", TRUE)
    assert not maps[:2].any()
    np.testing.assert_array_equal(maps[2:], TRUE.depth[2:])
    assert apply_known(SMALL, read_known(KnownGeometry(known_depths=some), SMALL))[1] == pytest.approx(4)
    write(tmp_path / "order", unidepth, TRUE.depth, ("d9", "d10", "d11", "d100"))
    np.testing.assert_array_equal(read_depth_maps(tmp_path / "order", TRUE), TRUE.depth)
    (tmp_path / "order/d9.npy").unlink()
    with pytest.raises(InputError, match="3 depth maps for 4 frames, and none is named like a frame, such as a0"):
        read_depth_maps(tmp_path / "order", TRUE)


def test_a_crop_and_padding_take_the_same_places(tmp_path):
    """The clip shows 40 x 20 of its source's pixels, of which a map has a quarter in each direction."""
    room = make_room(
        frames=1,
        source_size=np.array([[40, 80]]),
        source_scale=np.ones((1, 2)),
        source_offset=np.array([[20.0, 6.0]]),
        valid_box=np.array([[2, 4, 40, 28]]),
    )
    depth = 1 + np.arange(200, dtype=np.float32).reshape(10, 20)
    write(tmp_path / "maps", unidepth, [depth], ["only"])
    found = read_depth_maps(tmp_path / "maps", room)[0]
    assert not found[:4].any()
    assert not found[:, :2].any()
    assert found[4, 2] == depth[10 // 4, 22 // 4]
    assert found[27, 39] == depth[33 // 4, 59 // 4]


def test_disparities_are_warned_of(tmp_path, caplog):
    folder = write(tmp_path / "maps", unidepth, 10 / TRUE.depth)
    apply_known(SMALL, read_known(KnownGeometry(known_depths=folder), SMALL))
    assert "fall where the prediction rises; are they disparities" in caplog.text


@pytest.mark.parametrize(
    ("writer", "depth", "words"),
    [
        (unidepth, np.ones((84, 56)), "has 56 x 84 pixels and its picture 168 x 112; expected the same shape.*EXIF"),
        (unidepth, np.ones((56, 56)), "expected the same shape$"),
        (unidepth, np.full((56, 84), np.nan), "has maps without a known depth"),
        (lambda path, depth: np.savez(path, a=depth, b=depth), np.ones((56, 84)), "has the arrays a, b; expected one"),
        (lambda path, depth: path.with_suffix(".npz").write_bytes(b"PK\3\4"), np.ones((56, 84)), "cannot be read"),
        (lambda path, depth: np.save(path, np.array([{}], object)), np.ones((56, 84)), "a0.npy"),
        (lambda path, depth: path.with_suffix(".txt").touch(), np.ones((56, 84)), "has no depth maps; expected .npz"),
    ],
)
def test_maps_that_do_not_fit_are_refused_in_a_sentence(tmp_path, writer, depth, words):
    folder = write(tmp_path / "maps", writer, [depth] * 4)
    with pytest.raises(InputError, match=words):
        read_known(KnownGeometry(known_depths=folder), TRUE)


def test_options_without_depths_are_refused():
    per_metre: dict[str, Any] = {"depths_per_metre": 256.0}
    wrong = [{"robust": True}, per_metre, per_metre | {"known_depths": "source"}]
    for options in wrong:
        with pytest.raises(InputError, match="with --known-depths"):
            KnownGeometry(**options)
    with pytest.raises(InputError, match=r"depths_per_metre is 0\.0; expected a number above 0"):
        KnownGeometry(known_depths="maps", depths_per_metre=0)


ROOM = make_room(frames=5)
QUARTER = scaled(ROOM, 0.25)


def check_scale(known):
    found, unit = apply_known(QUARTER, read_known(known, QUARTER))
    assert unit == pytest.approx(4, rel=1e-4)
    np.testing.assert_allclose(found.depth, ROOM.depth, rtol=1e-4)
    np.testing.assert_allclose(found.camera_centres, ROOM.camera_centres, atol=1e-4)
    assert found.length_unit == "metre"
    assert found.known_facts["scale"].startswith("4 metres per unit")


def test_known_depths_give_the_scale_despite_an_outlier(tmp_path):
    lines = [f"{i},{2 * x + 1},{2 * y + 1},{ROOM.depth[i, y, x]}" for i, x, y in ((0, 3, 4), (2, 8, 2), (4, 5, 9))]
    (tmp_path / "depths.csv").write_text("\n".join(["frame,x,y,depth", *lines, "1,3,3,900", ""]))
    check_scale(KnownGeometry(known_depths=str(tmp_path / "depths.csv")))


def test_a_baseline_gives_the_scale():
    metres = np.linalg.norm(ROOM.camera_centres[1] - ROOM.camera_centres[4])
    check_scale(KnownGeometry(baseline=f"1,4,{metres}"))
    still = make_room(frames=5, camera_from_world=np.tile(QUARTER.camera_from_world[:1], (5, 1, 1)))
    with pytest.raises(InputError, match=r"frames 0 and 2 are predicted .* median depths apart, which is no motion"):
        apply_known(still, read_known(KnownGeometry(baseline="0,2,1"), still))


def over_a_floor():
    """Return level cameras 1.6 above a floor that fills the lower half of the picture; the rest is 20 away."""
    poses = np.tile(np.eye(3, 4), (5, 1, 1))
    poses[:, 0, 3] = -np.arange(5) / 5
    y = (np.arange(28) + 0.5 - 14) / ROOM.intrinsics[0, 1, 1]
    depth = np.where(y > 0.08, 1.6 / np.maximum(y, 0.08), 20)[None, :, None] + np.zeros(ROOM.depth.shape)
    return make_room(frames=5, camera_from_world=poses, depth=depth, dynamic_mask=np.zeros(depth.shape, bool))


def test_the_height_above_the_floor_gives_the_scale():
    true, known = over_a_floor(), KnownGeometry(camera_height=1.6)
    small = scaled(true, 0.25)
    found, unit = apply_known(small, read_known(known, small))
    assert unit == pytest.approx(4, rel=1e-5)
    np.testing.assert_allclose(found.depth, true.depth, rtol=1e-5)
    with pytest.raises(InputError, match="finds no floor"):
        apply_known(ROOM, read_known(known, ROOM))  # it shows a wall


def test_depths_that_do_not_fit_are_refused(tmp_path):
    for text, message in (
        ("frame,x,y\n0,1,1\n", "line 2 is .* expected columns frame, x, y and depth"),
        ("frame,x,y,depth\n9,1,1,1\n", "line 2 is .* a frame of 0 to 4"),
        ("frame,x,y,depth\n0,99,1,1\n", r"line 2: \(99, 1\) lies outside .* a picture of 84 x 56 pixels"),
    ):
        (tmp_path / "depths.csv").write_text(text)
        with pytest.raises(InputError, match=message):
            apply_known(QUARTER, read_known(KnownGeometry(known_depths=str(tmp_path / "depths.csv")), QUARTER))
