"""The renderer is exact: what one frame's truth says of a point, another frame's rays find there; and its shapes."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.shared.generated import DYNAMIC, QUICK, STATIC, clips, gauge, keys, scenes, textures
from vggtjax.training.scenes import cast, sample_scene
from vggtjax.training.scenes.scene import camera_pose, part_poses
from vggtjax.training.scenes.shapes import SHAPES, box_normal, cylinder_normal, ellipsoid_normal

COUNT = 6
S, H, W = DYNAMIC.frames, DYNAMIC.height, DYNAMIC.width
KINDS = ("room", *DYNAMIC.kinds)
TIMES = np.arange(S, dtype=np.float32) * np.float32(1 / (S - 1))


class Pair(NamedTuple):
    """The pixels of frame i, [P, ...], carried to frame j with the things they are on."""

    clip: int
    i: int
    j: int
    part_ids: np.ndarray
    world: np.ndarray  # where the point is at the time of frame j
    pixels: np.ndarray  # where frame j's camera sees it
    z: np.ndarray
    inside: np.ndarray  # that frame's picture
    outward: np.ndarray  # below 1 where the way to the camera starts inside the point's own part


@pytest.fixture(scope="module")
def dynamic():
    return clips(DYNAMIC, COUNT)


@pytest.fixture(scope="module")
def static():
    return clips(STATIC, 3)


@pytest.fixture(scope="module")
def look():
    """Depth and parts that scene n's rays find at a time and at pixels [P, 2]."""

    every = scenes(DYNAMIC, COUNT)

    def at(scene, textures, time, pixels):
        surface = cast(scene, textures, DYNAMIC, time, pixels)
        return surface.depth, surface.part_ids

    compiled = jax.jit(at, compiler_options=QUICK)

    def find(n, time, pixels):
        scene = jax.tree.map(lambda leaf: leaf[n], every)
        return jax.device_get(compiled(scene, textures(), time, jnp.asarray(pixels, jnp.float32)))

    return find


@pytest.fixture(scope="module")
def pairs(dynamic):
    """Every ordered pair of frames of every clip."""
    sizes = np.asarray(scenes(DYNAMIC, COUNT).size, np.float64)
    places = [(clip, i, j) for clip, j, i in np.ndindex(COUNT, S, S) if i != j]
    return [carried(dynamic, sizes[clip], clip, i, j) for clip, i, j in places]


def carried(truth, sizes, clip, i, j):
    world, ids = points(truth, clip, i), truth.part_ids[clip, i].ravel()
    before, after = (truth.world_from_part[clip, frame, ids].astype(np.float64) for frame in (i, j))
    local = np.einsum("pji,pj->pi", before[..., :3], world - before[..., 3])
    world = np.einsum("pij,pj->pi", after[..., :3], local) + after[..., 3]
    camera, intrinsics = camera_of(truth, clip, j)
    seen = world @ camera[:, :3].T + camera[:, 3]
    pixels, z = project(seen, intrinsics), seen[:, 2]
    inside = (z > 0.05) & (pixels > 0).all(axis=1) & (pixels < [W, H]).all(axis=1)
    towards = np.einsum("pji,pj->pi", after[..., :3], -camera[:, :3].T @ camera[:, 3] - world)
    outward = np.full(len(ids), 2.0)  # nothing hides behind the room itself, which is seen from inside
    for part in np.unique(ids[ids > 0]):
        own = ids == part
        outward[own] = gauge(KINDS[part], (local + 5e-4 * towards)[own], sizes[part - 1])
    return Pair(clip, i, j, ids, world, np.where(inside[:, None], pixels, 0.0), z, inside, outward)


def points(truth, clip, frame):
    """World points [P, 3] of a frame's pixels, in float64."""
    camera, intrinsics = camera_of(truth, clip, frame)
    y, x = np.mgrid[0:H, 0:W] + 0.5
    rays = np.stack([(x - W / 2) / intrinsics[0, 0], (y - H / 2) / intrinsics[1, 1], np.ones((H, W))], axis=-1)
    seen = (rays * truth.depth[clip, frame, ..., None].astype(np.float64)).reshape(-1, 3)
    return (seen - camera[:, 3]) @ camera[:, :3]


def camera_of(truth, clip, frame):
    return truth.camera_from_world[clip, frame].astype(np.float64), truth.intrinsics[clip, frame].astype(np.float64)


def project(seen, intrinsics):
    with np.errstate(divide="ignore", invalid="ignore"):
        return (seen / seen[:, 2:] @ intrinsics.T)[:, :2]


def test_points_are_found_where_they_are_said_to_be(pairs, look):
    agreeing = 0
    for pair in pairs:
        depth, part_ids = look(pair.clip, TIMES[pair.j], pair.pixels)
        relative = (depth - pair.z) / np.maximum(pair.z, 0.05)
        same = pair.inside & (part_ids == pair.part_ids)
        faces = same & (pair.outward > 1 + 1e-4)
        assert (np.abs(relative[faces]) < 1e-3).all()
        hidden = same & (pair.outward < 1 - 1e-4)  # by its own part
        assert (relative[hidden] < -1e-4).all()
        behind = pair.inside & (relative > 1e-3)  # seen past a silhouette, half a rounding away
        assert behind.sum() <= 0.005 * pair.inside.sum()
        agreeing += (np.abs(relative[faces]) < 1e-3).sum()
    assert agreeing > 0.5 * sum(pair.inside.sum() for pair in pairs)
    moved = [np.isin(pair.part_ids, movers(clips(DYNAMIC, COUNT), pair.clip)) & pair.inside for pair in pairs]
    assert sum(m.sum() for m in moved) > 1000


def test_scene_flow_leads_to_the_next_frame(dynamic, pairs):
    for pair in pairs:
        if pair.j == pair.i + 1:
            flow = dynamic.scene_flow[pair.clip, pair.i].reshape(-1, 3)
            np.testing.assert_allclose(points(dynamic, pair.clip, pair.i) + flow, pair.world, atol=1e-5)
    last = np.abs(dynamic.scene_flow[:, -1][dynamic.dynamic_mask[:, -1]])
    assert last.max() > 1e-3  # things go on after the last frame


def movers(truth, clip):
    """Parts whose pose changes between frames."""
    poses = truth.world_from_part[clip]
    return np.flatnonzero((np.abs(poses - poses[:1]) > 1e-6).any(axis=(0, 2, 3)))


def test_the_dynamic_mask_is_where_movers_are(dynamic):
    objects = np.array([0, *(1 + np.array(DYNAMIC.objects))])
    np.testing.assert_array_equal(dynamic.object_ids, objects[dynamic.part_ids])
    for clip in range(COUNT):
        moving = movers(dynamic, clip)
        assert 0 not in moving
        assert 1 <= len(np.unique(objects[moving])) <= 3
        assert set(np.flatnonzero(np.isin(objects, objects[moving]))) == set(moving)  # things move as a whole
        np.testing.assert_array_equal(dynamic.dynamic_mask[clip], np.isin(dynamic.part_ids[clip], moving))
    flow = np.abs(dynamic.scene_flow).max(axis=-1)
    assert flow[~dynamic.dynamic_mask].max() < 1e-5
    assert np.median(flow[dynamic.dynamic_mask]) > 1e-2


def test_ranges(dynamic):
    assert 0 <= dynamic.images.min() < dynamic.images.max() <= 1
    assert dynamic.images.std(axis=(2, 3)).min() > 0.02  # no blank frames
    assert dynamic.depth.min() > 0.1
    focal, centre = dynamic.intrinsics[..., [0, 1], [0, 1]], dynamic.intrinsics[..., :2, 2]
    np.testing.assert_array_equal(focal[..., 0], focal[..., 1])
    np.testing.assert_array_equal(centre, np.broadcast_to([W / 2, H / 2], centre.shape))
    degrees, (low, high) = np.degrees(2 * np.arctan(W / 2 / focal)), DYNAMIC.field_of_view
    assert low - 1e-3 < degrees.min() < degrees.max() < high + 1e-3


def test_cameras_stay_in_the_room_and_out_of_things():
    def one(key):
        scene = sample_scene(key, 3, DYNAMIC)
        times = jnp.linspace(0, 1, 9)
        centre = jax.vmap(lambda time: camera_pose(scene.camera, time)[1])(times)
        rotation, middle = jax.vmap(lambda time: part_poses(scene, DYNAMIC, time))(times)
        local = jnp.einsum("tkji,tkj->tki", rotation, centre[:, None] - middle)
        return centre, local, scene

    centre, local, scene = jax.device_get(jax.jit(jax.vmap(one), compiler_options=QUICK)(keys(200)))
    assert (centre > scene.room_low[:, None]).all()
    assert (centre < scene.room_high[:, None]).all()
    for part, kind in enumerate(DYNAMIC.kinds):
        assert gauge(kind, local[:, :, part], scene.size[:, None, part])[scene.present[:, part]].min() > 1


def test_static_clips_and_cameras_stand_still(static):
    assert not static.dynamic_mask.any()
    assert np.abs(static.scene_flow).max() < 1e-5
    assert (np.abs(np.diff(static.camera_from_world, axis=1)).max(axis=(2, 3)) > 1e-4).all()  # but the camera does
    config = dataclasses.replace(DYNAMIC, static_camera=1.0)

    def poses(key):
        camera = sample_scene(key, 3, config).camera
        return jax.vmap(lambda time: camera_pose(camera, time))(jnp.asarray(TIMES))

    for still in jax.device_get(jax.jit(jax.vmap(poses), compiler_options=QUICK)(keys(20))):
        np.testing.assert_array_equal(still, np.broadcast_to(still[:, :1], still.shape))


@pytest.mark.parametrize(
    ("change", "axis", "least", "most"), [({"pitch": (-10, 30)}, 2, -10, 30), ({"roll": 20}, 0, -20, 20)]
)
def test_a_tilted_camera_turns_on_the_spot(change, axis, least, most):
    """Pitch turns the forward axis, roll the right axis, down for positive angles; by one angle in a clip."""

    def poses(key):
        cameras = [sample_scene(key, 3, config).camera for config in (DYNAMIC, dataclasses.replace(DYNAMIC, **change))]
        return [jax.vmap(lambda time, seen=seen: camera_pose(seen, time))(jnp.asarray(TIMES)) for seen in cameras]

    (level, before), (tilted, after) = jax.device_get(jax.jit(jax.vmap(poses), compiler_options=QUICK)(keys(200)))
    np.testing.assert_array_equal(before, after)
    cosine = np.einsum("nti,nti->nt", level[..., axis], tilted[..., axis])
    falls = tilted[..., 1, axis] > level[..., 1, axis]
    angle = np.where(falls, 1, -1) * np.degrees(np.arccos(cosine.clip(-1, 1)))
    assert np.ptp(angle, axis=1).max() < 0.1
    assert least - 0.1 < angle.min() < least + 3
    assert most - 3 < angle.max() < most + 0.1


@pytest.mark.proof
def test_samples_and_exposures_change_images_only(dynamic):
    blurred = clips(dataclasses.replace(DYNAMIC, samples=2, shutter=0.5, exposures=2), 2)
    sharp = jax.tree.map(lambda leaf: leaf[:2], dynamic)
    assert (np.abs(blurred.depth - sharp.depth) > 2e-3).mean() < 1e-3  # but for rounding at edges
    assert (blurred.part_ids != sharp.part_ids).mean() < 1e-3
    difference = np.abs(blurred.images - sharp.images)
    assert difference.max() > 0.1
    assert difference.mean() < 0.05  # it is the same scene


SIZE = (1.0, 2.0, 3.0)


def test_normals_by_hand():
    size = jnp.asarray(SIZE)[:, None] * jnp.ones((1, 4))
    points = jnp.asarray([(1, 0.5, 0.5), (-0.2, -2, 1), (0, 1.9, -3), (-1, 1.9, 2.9)]).T
    np.testing.assert_array_equal(box_normal(points, size).T, [(1, 0, 0), (0, -1, 0), (0, 0, -1), (-1, 0, 0)])

    size = jnp.asarray([2.0, 1, 1])[:, None] * jnp.ones((1, 3))
    points = jnp.asarray([(2, 0, 0), (0, 0, -1), (2**0.5, 0.5**0.5, 0)]).T  # the last: gradient (x / 4, y)
    expected = [(1, 0, 0), (0, 0, -1), (0.2**0.5, 0.8**0.5, 0)]
    np.testing.assert_allclose(ellipsoid_normal(points, size).T, expected, atol=1e-6)

    size = jnp.asarray([2.0, 1, 1])[:, None] * jnp.ones((1, 4))
    points = jnp.asarray([(0.1, 1, 0.1), (-1, -1, 0.5), (-2, 0.3, 0), (2**0.5, -0.9, 0.5**0.5)]).T
    expected = [(0, 1, 0), (0, -1, 0), (-1, 0, 0), (0.2**0.5, 0, 0.8**0.5)]
    np.testing.assert_allclose(cylinder_normal(points, size).T, expected, atol=1e-6)


coordinate = st.floats(-1, 1)
vector = st.tuples(coordinate, coordinate, coordinate)
extent = st.floats(0.2, 2)


@pytest.mark.parametrize("shape", list(SHAPES))
@settings(max_examples=40)
@given(start=vector, through=vector, size=st.tuples(extent, extent, extent))
def test_a_ray_enters_and_leaves_on_the_surface(shape, start, through, size):
    origin, size = 8 * np.array(start), np.array(size)
    direction = 2 * np.array(through) * size - origin  # towards the shape or past it
    assume(np.linalg.norm(direction) > 0.5)
    eye, ray = (jnp.asarray(v, jnp.float32)[None, :, None] for v in (origin, direction))
    near, far = (float(reach[0, 0]) for reach in SHAPES[shape][0](eye, ray, jnp.asarray(size, jnp.float32)[None]))
    along = np.linspace(-4, 6, 2001)
    outward = gauge(shape, origin + along[:, None] * direction, size)
    if not near < far:
        assert outward.min() > 1 - 2e-2  # a ray that just touches may be called a miss
        return
    points = origin + np.array([[near], [(near + far) / 2], [far]]) * direction
    at = gauge(shape, points, size)
    assert at[[0, 2]] == pytest.approx(1, abs=2e-3)
    assert at[1] < 1 + 2e-3
    clear = (np.abs(along - near) > 0.02) & (np.abs(along - far) > 0.02) & (np.abs(outward - 1) > 1e-2)
    np.testing.assert_array_equal((outward < 1)[clear], ((near < along) & (along < far))[clear])
    assume((far - near) * np.linalg.norm(direction) > 0.1)
    normal = np.asarray(SHAPES[shape][1](jnp.asarray(points[[0]].T), jnp.asarray(size[:, None])))[:, 0]
    assert np.linalg.norm(normal) == pytest.approx(1, abs=1e-5)
    assert normal @ direction < 0.05 * np.linalg.norm(direction)  # faces the ray, but at an edge it may be the other's
