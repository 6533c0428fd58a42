"""Clips of generated worlds: what they say of themselves agrees with what they show."""

import dataclasses

import numpy as np
import pytest
import trimesh

from tests.shared.asset_folder import write_assets
from vggtjax.errors import InputError
from vggtjax.training.world.assets import PANORAMA, make_tiles, read_assets, sample_panorama, sample_tiles
from vggtjax.training.world.casting import Light, Moment, Stage, World, prepare
from vggtjax.training.world.clip import world_clip
from vggtjax.training.world.config import Cameras, Movers, Places, WorldConfig
from vggtjax.training.world.meshes import Surface, box, join, pillar
from vggtjax.training.world.motion import STEPS, Actor
from vggtjax.training.world.places import make_place
from vggtjax.training.world.sampling import draw_actors, draw_camera

SIZE = {"frames": 4, "height": 32, "width": 48, "patch": 4}
SHARP = WorldConfig(blur=0, rolling=0, compression=0, noise=0, flicker=0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_assets(tmp_path_factory.mktemp("assets") / "assets")


@pytest.fixture(scope="module")
def assets(folder):
    return read_assets(folder)


@pytest.fixture(scope="module", params=Places.__dataclass_fields__)
def clip(request, assets):
    """A clip of each kind of place, in which something moves."""
    places = dataclasses.replace(Places(0, 0, 0), **{request.param: 1.0})
    config = dataclasses.replace(SHARP, places=places, dynamic=1.0, cameras=Cameras(1, 1, 0, 0, 0))
    return world_clip(assets, config, (3, 5), **SIZE)


def camera_points(clip, frame, points):
    """Points [P, 3] of the world as a frame's camera has them."""
    pose = clip.camera_from_world[frame].astype(np.float64)
    return points @ pose[:, :3].T + pose[:, 3]


def test_tracks_start_at_their_patch_and_agree_with_depth_where_they_are_seen(clip):
    S, H, W = clip.depth.shape
    fx, cx, cy = clip.intrinsics[0, 0], clip.intrinsics[0, 2], clip.intrinsics[1, 2]
    y, x = (np.mgrid[2:H:4, 2:W:4] + 0.5).reshape(2, -1)
    hits = total = 0
    for r, s in np.ndindex(S, S):
        known = (clip.depth[r, 2::4, 2::4] > 0).ravel()
        seen = camera_points(clip, s, clip.tracks[r, known, s])
        u, v = fx * seen[:, 0] / seen[:, 2] + cx, fx * seen[:, 1] / seen[:, 2] + cy
        if r == s:
            np.testing.assert_allclose(np.stack([u, v]), np.stack([x, y])[:, known], atol=2e-2)
            np.testing.assert_allclose(seen[:, 2], clip.depth[r, 2::4, 2::4].ravel()[known], rtol=1e-3)
            continue
        inside = (seen[:, 2] > 0.1) & (u > 0) & (u < W) & (v > 0) & (v < H)
        shown = clip.depth[s, v[inside].astype(int), u[inside].astype(int)]
        ratio = shown / seen[inside, 2]
        hits, total = hits + (np.abs(ratio - 1) < 0.05).sum(), total + (ratio > 0.95).sum()
    assert total > 50
    assert hits > 0.8 * total  # where nothing stands before a point, the depth shown there is its own, but at edges


def test_what_moves_moves_and_what_stands_still_does_not(clip):
    assert clip.dynamic_mask.any()
    still = (clip.object_ids == 0) & (clip.depth > 0)
    assert np.abs(clip.scene_flow[still]).max() < 1e-5
    assert np.abs(clip.scene_flow[clip.dynamic_mask]).max() > 1e-3
    r, p = np.argwhere(clip.dynamic_mask[:-1, 2::4, 2::4].reshape(len(clip.depth) - 1, -1))[0]
    row, column = np.divmod(p, SIZE["width"] // 4)
    moved = clip.tracks[r, p, r + 1] - clip.tracks[r, p, r]
    np.testing.assert_allclose(moved, clip.scene_flow[r, 4 * row + 2, 4 * column + 2], atol=1e-4)


def test_a_seed_is_a_clip_and_splits_share_no_file(assets, folder):
    one, same, other = (world_clip(assets, WorldConfig(), seed, **SIZE) for seed in ((0, 7), (0, 7), (0, 8)))
    for a, b in zip(one, same, strict=True):
        np.testing.assert_array_equal(a, b)
    assert (one.images != other.images).mean() > 0.5
    assert not set(read_assets(folder, "test").shapes) & set(assets.shapes)


def test_hits_are_those_of_a_slow_search():
    """Against Moeller and Trumbore's test of every triangle, in float64, with a thing that has moved."""
    generator = np.random.default_rng(0)
    look = Surface(0)
    still = join([box((2, 2, 0.2), look), pillar(0.3, 1.0, look)])
    mover = box((0.5, 0.5, 0.5), look)
    place = np.linspace([0, -1, 0.5], [0, 1, 0.5], STEPS)
    actor = Actor(mover, mover.vertices[None], 0.0, 0.0, 2.0, place, np.zeros((STEPS, 3)))
    light = Light(np.array([0, 0, 1.0]), False, 1.0, np.ones(3))
    tiles = make_tiles([np.full((128, 128, 3), 128, np.uint8)])
    moment = Moment(Stage(World(prepare(still), (actor,), light, np.zeros((2, 4, 3), np.uint8), 0.0), tiles), 1.5)
    origin = np.asarray(generator.normal((0, 0, 4), 1, (300, 3)), np.float32)
    direction = np.asarray(generator.normal((0, 0, -1), 0.3, (300, 3)), np.float32)
    hits = moment.cast(origin, direction)
    triangles = np.concatenate([m[f] for m, f in ((still.vertices, still.faces), (moment.positions[0], mover.faces))])
    np.testing.assert_allclose(moment.positions[0].mean(axis=0), [0, 0.5, 0.75], atol=1e-6)
    expected, face = slow_hits(triangles.astype(np.float64), origin, direction)
    assert 0.2 < np.isfinite(expected).mean() < 1
    np.testing.assert_allclose(hits.distance, expected, rtol=1e-4)
    np.testing.assert_array_equal(hits.actor > 0, np.isfinite(expected) & (face >= len(still.faces)))
    np.testing.assert_array_equal(hits.actor < 0, ~np.isfinite(expected))


def slow_hits(triangles, origin, direction):
    a, b, c = (triangles[None, :, i] for i in range(3))
    o, d = (x[:, None].astype(np.float64) for x in (origin, direction))
    normal = np.cross(b - a, c - a)
    t = np.einsum("pfc,pfc->pf", a - o, normal + 0 * d) / np.einsum("pfc,pfc->pf", d + 0 * a, normal + 0 * d)
    point = o + t[..., None] * d
    inside = t > 0
    for p, q in ((a, b), (b, c), (c, a)):
        inside &= np.einsum("pfc,pfc->pf", np.cross(q - p + 0 * point, point - p), normal + 0 * point) >= 0
    t = np.where(inside, t, np.inf)
    return t.min(axis=1), t.argmin(axis=1)


def test_samples_of_tiles_and_panoramas():
    """In the middle of texels and directions a sample is the picture's own value; a coarse pixel is the mean."""
    generator = np.random.default_rng(0)
    picture = generator.integers(0, 256, (128, 128, 3)).astype(np.uint8)
    tiles = make_tiles([np.zeros_like(picture), picture])
    at = generator.integers(0, 128, (20, 2))
    uv = (at + 0.5) / 128 + generator.integers(-2, 3, (20, 2))  # tiles repeat
    found = sample_tiles(tiles, np.ones(20, int), uv, np.full(20, 1 / 128))
    np.testing.assert_allclose(255 * found, picture[at[:, 1], at[:, 0]], atol=1e-2)
    coarse = sample_tiles(tiles, np.ones(20, int), uv, np.full(20, 1 / 16))
    assert np.abs(coarse - picture.mean() / 255).max() < 0.3
    sky = generator.integers(0, 256, (*PANORAMA, 3)).astype(np.uint8)
    H, W = PANORAMA
    row, column = np.array([40, 90, 150]), np.array([0, 100, 383])
    azimuth, elevation = 2 * np.pi * (column + 0.5) / W, np.pi * (0.5 - (row + 0.5) / H)
    flat = np.cos(elevation)
    direction = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
    np.testing.assert_allclose(255 * sample_panorama(sky, direction), sky[row, column], atol=0.5)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda f: f / "nowhere", "is not a folder"),
        (lambda f: (f / "textures/brick_9.png").write_bytes(b"no picture"), "brick_9.png"),
        (lambda f: np.savez(f / "objects/bad9.npz", vertices=np.zeros((3, 2))), "is not an object"),
        (lambda f: (f / "objects/bad9.npz").write_bytes(b"PK nothing"), "bad9.npz"),
        (lambda f: [path.unlink() for path in (f / "objects").iterdir()], "no objects at rest for training"),
    ],
)
def test_folders_that_are_none_are_refused_in_a_sentence(tmp_path, spoil, words):
    made = write_assets(tmp_path / "assets")
    result = spoil(made)
    with pytest.raises(InputError, match=words):
        read_assets(result if hasattr(result, "joinpath") else made)


@pytest.mark.parametrize(
    "values", [{"places": Places(0, 0, 0)}, {"movers": Movers(-1, 1, 1, 1)}, {"seconds": (2, 1)}, {"dynamic": 2}]
)
def test_rows_out_of_range_are_refused(values):
    with pytest.raises(InputError):
        WorldConfig(**values)


def test_tables_are_where_they_are_said_to_be_and_filmed_from_above(assets):
    generator, tops, bare = np.random.default_rng(4), 0, 0
    film = {share: dataclasses.replace(SHARP, tabletop=share) for share in (0.0, 1.0)}
    down: dict[float, list[float]] = {0.0: [], 1.0: []}
    for _ in range(12):
        place = make_place(generator, assets, "room", 1.5)
        if not place.tops:
            continue
        moment = Moment(Stage(World(prepare(join(place.still)), (), place.light, place.panorama, 0.0), assets.tiles), 0)
        for top in place.tops:
            above = np.add(top.point(generator), [0, 0, 0.6]).astype(np.float32)
            below = moment.cast(above[None], np.array([[0, 0, -1]], np.float32)).distance[0]
            assert below < 0.6 + 1e-3, "a ray from above meets the top or what stands on it"
            tops, bare = tops + 1, bare + (below > 0.6 - 1e-3)
        for share, config in film.items():
            rotation = draw_camera(generator, place, [], config, 1.0).path.pose(0.5)[0]
            down[share].append(-rotation[2, 2])
    assert tops > 10
    assert bare > 0.5 * tops
    assert np.mean(down[1.0]) > np.mean(down[0.0]) + 0.1


def test_things_move_over_tables_and_stay_there(assets):
    generator, config, over = np.random.default_rng(5), WorldConfig(tabletop=1.0, movers=Movers(0, 0, 1, 0)), 0
    for _ in range(12):
        place = make_place(generator, assets, "room", 1.5)
        for actor in draw_actors(generator, assets, place, config, 4.0) if place.tops else []:
            shares = [
                np.abs(
                    (actor.place - top.middle) @ np.stack([axis / (axis @ axis) for axis in (top.along, top.across)]).T
                )
                for top in place.tops
            ]
            assert any((share < 1.001).all() for share in shares)
            over += 1
    assert over > 5


def test_boxes_are_closed():
    """The light falls on the outside of every face: normals of the made meshes point outwards."""
    for mesh in (box((1, 2, 3), Surface(0)), pillar(1, 2, Surface(0))):
        assert trimesh.Trimesh(mesh.vertices, mesh.faces).volume > 0


def test_a_rolling_shutter_and_blur_are_centred_on_the_truth(assets):
    """The mean shift between pictures with and without them is less than half a pixel, on a camera that turns fast."""
    turning = dataclasses.replace(SHARP, dynamic=0, cameras=Cameras(0, 0, 1, 0, 0), seconds=(0.6, 0.6), shake=0)
    shape = {"frames": 3, "height": 32, "width": 48}
    for flaw in ("blur", "rolling"):
        shifts = []
        for seed in range(6):
            sharp, flawed = (
                world_clip(assets, dataclasses.replace(turning, **{flaw: x}), (seed,), **shape) for x in (0, 1)
            )
            np.testing.assert_array_equal(sharp.camera_from_world, flawed.camera_from_world)
            a, b = (clip.images[1].astype(float).mean(axis=-1) for clip in (sharp, flawed))
            shifts.append(shift_along_x(a, b))
        assert abs(np.mean(shifts)) < 0.5, flaw


def shift_along_x(a, b):
    """Pixels by which `b` lies to the right of `a`, by least squares of the brightness against its slope."""
    slope = np.gradient(a, axis=1)
    return -((b - a) * slope).sum() / (slope**2).sum()


def test_portrait_clips_have_the_field_of_view_along_the_longer_side(assets):
    config = dataclasses.replace(SHARP, field_of_view=(60, 60))
    for height, width in ((48, 32), (32, 48)):
        clip = world_clip(assets, config, (1,), frames=2, height=height, width=width)
        assert clip.intrinsics[0, 0] == pytest.approx(24 / np.tan(np.deg2rad(30)))
        assert clip.tracks.shape == (2, 0, 2, 3)


def test_what_stands_before_the_light_is_dark():
    """A plate under a lid sees the sun from the side alone."""
    look = Surface(0)
    plate, lid = box((4, 4, 0.1), look), box((1, 1, 0.1), look).moved(np.eye(3), np.array([0, 0, 1.0]))
    sun = Light(np.array([0, 0, 1.0]), False, 0.2, np.ones(3))
    tiles = make_tiles([np.full((128, 128, 3), 255, np.uint8)])
    stage = Stage(World(prepare(join([plate, lid])), (), sun, np.zeros((2, 4, 3), np.uint8), 0.0), tiles)
    origin = np.asarray([[0.2, 0.1, 0.5], [1.5, 0.1, 0.5], [0.2, 0.1, 3]], np.float32)
    direction = np.asarray([[0, 0, -1]] * 3, np.float32)
    moment = Moment(stage, 0.0)
    shade, lit, top = moment.colours(moment.cast(origin, direction), origin, direction, 0.01)[:, 0]
    assert shade == pytest.approx(0.2)
    assert lit == top == 1
