"""What the network should say, and where patches are seen again: by hand and against slow loops in float64."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.shared.generated import DYNAMIC, QUICK, clips
from vggtjax.network.heads.pose import decode_pose
from vggtjax.training.matching import MatchLoss, match_loss
from vggtjax.training.objective import dense_loss
from vggtjax.training.scenes import SyntheticClip
from vggtjax.training.truth import OCCLUDED, Matches, clips_of, match_counts, matches, mirrored, targets

PATCH = 4
CENTRE = slice(PATCH // 2, None, PATCH)


@partial(jax.jit, compiler_options=QUICK)
def quick_targets(scenes):
    return targets(clips_of(scenes, PATCH))


@partial(jax.jit, compiler_options=QUICK)
def quick_matches(scenes):
    return matches(clips_of(scenes, PATCH), PATCH)


@pytest.fixture(scope="module")
def clip():
    return clips(DYNAMIC, 6)  # as many as the tests of the renderer, which may have drawn them already


@pytest.fixture(scope="module")
def found(clip):
    return jax.device_get(quick_matches(jax.tree.map(jnp.asarray, clip)))


def doubled(clip):
    """Everything that is computed with, in float64."""
    names = ("depth", "scene_flow", "camera_from_world", "intrinsics", "world_from_part")
    return clip._replace(**{name: getattr(clip, name).astype(np.float64) for name in names})


def world_points(clip):
    """[B, S, H, W, 3], of a clip in float64."""
    H, W = clip.depth.shape[2:]
    y, x = np.mgrid[0:H, 0:W] + 0.5
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1)
    rays = np.einsum("bsij,hwj->bshwi", np.linalg.inv(clip.intrinsics), pixels)
    seen = rays * clip.depth[..., None] - clip.camera_from_world[:, :, None, None, :, 3]
    return np.einsum("bsji,bshwj->bshwi", clip.camera_from_world[..., :3], seen)


def project(clip, points):
    """Positions in pixels and depth of points [B, S, P, 3], those of frame s in frame s."""
    seen = np.einsum("bsij,bspj->bspi", clip.camera_from_world[..., :3], points)
    seen = seen + clip.camera_from_world[:, :, None, :, 3]
    pixels = np.einsum("bsij,bspj->bspi", clip.intrinsics, seen / seen[..., 2:])
    return pixels[..., :2], seen[..., 2]


def test_targets(clip):
    truth = jax.device_get(quick_targets(jax.tree.map(jnp.asarray, clip)))
    clip = doubled(clip)
    H, W = clip.depth.shape[2:]
    np.testing.assert_allclose(np.linalg.norm(truth.points, axis=-1).mean(axis=(1, 2, 3)), 1, atol=1e-5)
    scale = (clip.depth / truth.depth).mean(axis=(1, 2, 3))
    np.testing.assert_allclose(truth.depth * scale[:, None, None, None], clip.depth, rtol=1e-5)

    camera, intrinsics = jax.device_get(decode_pose(jnp.asarray(truth.pose_encoding), (H, W)))
    np.testing.assert_allclose(camera[:, 0], np.broadcast_to(np.eye(3, 4), camera[:, 0].shape), atol=2e-6)
    np.testing.assert_allclose(intrinsics, clip.intrinsics, rtol=1e-4)
    rotation, translation = clip.camera_from_world[..., :3], clip.camera_from_world[..., 3]
    relative = rotation @ rotation[:, :1].swapaxes(-1, -2)
    np.testing.assert_allclose(camera[..., :3], relative, atol=1e-5)
    moved = translation - np.einsum("bsij,bj->bsi", relative, translation[:, 0])
    np.testing.assert_allclose(camera[..., 3] * scale[:, None, None], moved, atol=1e-4)

    world = truth.points * scale[:, None, None, None, None] - translation[:, 0, None, None, None]
    world = np.einsum("bji,bshwj->bshwi", rotation[:, 0], world)
    np.testing.assert_allclose(world, world_points(clip), atol=1e-4)


def passage():
    """A camera that stands, and a box that goes by, a patch further to the right in every frame.

    The wall is 8 m away, the box 4 m; the focal length is 16 pixels, so a patch of 4 pixels is 1 m wide at the box.
    """
    S, side = 3, 16
    part_ids = np.zeros((1, S, side, side), np.int32)
    for s in range(S):
        part_ids[0, s, 4:12, 4 * s : 4 * s + 4] = 1
    poses = np.tile(np.eye(3, 4, dtype=np.float32), (1, S, 2, 1, 1))
    poses[0, :, 1, 0, 3] = np.arange(S)
    intrinsics = np.array([[16, 0, 8], [0, 16, 8], [0, 0, 1]], np.float32)
    fields = {
        "images": np.zeros((1, S, side, side, 3), np.float32),
        "depth": np.where(part_ids == 1, 4, 8).astype(np.float32),
        "object_ids": part_ids,
        "part_ids": part_ids,
        "dynamic_mask": part_ids == 1,
        "scene_flow": np.zeros((1, S, side, side, 3), np.float32),
        "camera_from_world": np.tile(np.eye(3, 4, dtype=np.float32), (1, S, 1, 1)),
        "intrinsics": np.tile(intrinsics, (1, S, 1, 1)),
        "world_from_part": poses,
    }
    return SyntheticClip(**{name: jnp.asarray(field) for name, field in fields.items()})


def test_matches_by_hand():
    found = jax.device_get(quick_matches(passage()))
    assert found.position.shape == (1, 3, 3, 16, 2)
    for r, s, patch in np.ndindex(3, 3, 16):
        row, column = divmod(patch, 4)
        on_box = row in (1, 2) and column == r
        seen_at = column + s - r if on_box else column
        covered = not on_box and row in (1, 2) and column == s
        assert found.visible[0, r, s, patch] == (not covered)
        assert found.patch[0, r, s, patch] == 4 * row + seen_at
        expected = (4 * np.array([seen_at, row]) + 2.5) / 8 - 1  # the centre is the middle pixel's, of index 2
        np.testing.assert_allclose(found.position[0, r, s, patch], expected, atol=1e-5)


def test_matches_of_what_stands_still_need_no_poses_of_parts(clip, found):
    """Rigid geometry alone: unproject, project, compare with the depth shown there."""
    clip = doubled(clip)
    B, S = clip.depth.shape[:2]
    points = world_points(clip)[:, :, CENTRE, CENTRE].reshape(B, S, -1, 3)
    still = ~clip.dynamic_mask[:, :, CENTRE, CENTRE].reshape(B, S, -1)
    for r in range(S):
        pixels, z = project(clip, np.repeat(points[:, r : r + 1], S, axis=1))
        check(clip, found, r, pixels, z, np.repeat(still[:, r : r + 1], S, axis=1))
    assert found.visible[:, 0, 1].mean() > 0.3


def check(clip, found, r, pixels, z, chosen):
    """Compare matches from frame r with positions [B, S, P, 2] and depths [B, S, P], where `chosen`."""
    B, S, H, W = clip.depth.shape
    chosen = chosen & (z > 0.1)
    position = 2 * pixels / [W, H] - 1
    off = np.abs(found.position[:, r] - np.clip(position, -2, 2)).max(axis=-1)
    assert off[chosen].max() < 1e-3
    inside = (pixels > 0).all(axis=-1) & (pixels < [W, H]).all(axis=-1)
    column, row = np.moveaxis(np.floor(np.where(inside[..., None], pixels, 0)).astype(int), -1, 0)
    b, s = np.ogrid[:B, :S]
    shown = clip.depth[b[..., None], s[..., None], row, column]
    visible = inside & (np.abs(shown - z) < OCCLUDED * z)
    # Rounding may turn pixels that lie on a border of the grid, and depths on the tolerance.
    clear = chosen & (np.abs(pixels - np.round(pixels)).min(axis=-1) > 1e-3)
    clear &= np.abs(np.abs(shown - z) / z - OCCLUDED) > 1e-4
    assert clear.sum() > 0.8 * chosen.sum()
    np.testing.assert_array_equal(found.visible[:, r][clear], visible[clear])
    patch = row // PATCH * (W // PATCH) + column // PATCH
    np.testing.assert_array_equal(found.patch[:, r][clear & visible], patch[clear & visible])
    occluded = clear & inside & (shown < z * (1 - OCCLUDED))
    assert not found.visible[:, r][occluded].any()


def random_matches(generator, B, S, P):
    """Matches anywhere, of which some are seen; every patch is its own match."""
    patch = generator.integers(0, P, (B, S, S, P)).astype(np.int32)
    visible = generator.random((B, S, S, P)) < 0.6
    for s in range(S):
        patch[:, s, s], visible[:, s, s] = np.arange(P), True
    position = np.zeros((B, S, S, P, 2), np.float32)
    return Matches(*map(jnp.asarray, (position, patch, visible)))


def slow_match_loss(matches, q, k):
    """The cross-entropies and the accuracy, one patch at a time."""
    patch, visible = np.asarray(matches.patch), np.asarray(matches.visible)
    q, k = (np.asarray(a, np.float64) for a in (q, k))
    B, S, P, N, D = q.shape
    to_first, to_each, right = [], [], []
    for b, r, p in np.ndindex(B, S, P):
        logits = np.einsum("nd,sjnd->nsj", q[b, r, p], k[b]) / np.sqrt(D)
        if r > 0 and visible[b, r, 0, p]:
            heads = [log_softmax(logits[n].ravel())[patch[b, r, 0, p]] for n in range(N // 2)]
            to_first.append(np.mean(heads))
        for s in range(S):
            if s != r and visible[b, r, s, p]:
                among = log_softmax(logits[N // 2 :, s].mean(axis=0))
                to_each.append(among[patch[b, r, s, p]])
                right.append(among.argmax() == patch[b, r, s, p])
    return -np.mean(to_first) - np.mean(to_each), np.mean(right)


def log_softmax(x):
    return x - x.max() - np.log(np.exp(x - x.max()).sum())


def test_match_loss_against_a_slow_one_and_of_nothing_that_is_seen():
    generator = np.random.default_rng(5)
    B, S, P, D, heads = 2, 3, 4, 8, 5
    q, k = (jnp.asarray(generator.normal(0, 2, (B, S, P, heads, D)), jnp.float32) for _ in range(2))
    found = random_matches(generator, B, S, P)
    loss, accuracy = match_loss(found, match_counts(found), q, k)
    expected = slow_match_loss(found, q, k)
    assert (float(loss), float(accuracy)) == pytest.approx(expected, rel=1e-5)
    assert 0 < expected[1] < 1
    unseen = found._replace(visible=jnp.zeros_like(found.visible))
    assert [float(x) for x in match_loss(unseen, match_counts(unseen), q, k)] == [0, 0]


def test_the_loss_of_layers_is_the_mean_of_those_that_are_supervised():
    """Of their patches, which come after the other tokens of a frame."""
    generator = np.random.default_rng(0)
    B, S, P = 1, 3, 4
    q, k = (jnp.asarray(generator.normal(0, 2, (4, B, S, 1 + P, 2, 8)), jnp.float32) for _ in range(2))
    found = random_matches(generator, B, S, P)
    loss = MatchLoss(found, match_counts(found), (1, 3), depth=4)
    sums = loss.zeros(B, S, P)
    for layer, supervised in enumerate(loss.layer_counts()):
        sums = loss.add(sums, supervised, q[layer], k[layer])
    expected = np.mean([slow_match_loss(found, q[layer, :, :, 1:], k[layer, :, :, 1:]) for layer in (1, 3)], axis=0)
    assert [float(x) for x in sums] == pytest.approx(expected, rel=1e-5)


def test_the_sky_has_no_part_in_losses_and_matches():
    """Depth 0 in the upper half: the same loss, scale and matches, whatever is predicted there."""
    scenes = passage()
    clips = clips_of(scenes, PATCH)
    sky = clips._replace(depth=clips.depth.at[:, :, :8].set(0))
    truth = targets(sky)
    assert not truth.known[:, :, :8].any()
    below = np.linalg.norm(np.asarray(truth.points)[:, :, 8:], axis=-1)
    np.testing.assert_allclose(below.mean(), 1, atol=1e-5)
    seen = np.asarray(matches(sky, PATCH).visible).reshape(3, 3, 4, 4)
    assert not seen[:, :, :2].any()
    assert seen[:, :, 3].all()
    alone = targets(clips._replace(depth=jnp.zeros_like(clips.depth)))
    assert jnp.isfinite(alone.pose_encoding).all()


def test_dense_loss_by_hand():
    """Two equal rows of four pixels, the last of which is sky; errors count by their weight, with their gradient."""
    truth, values = jnp.asarray([1.0, 2.0, 4.0, 0.0]), jnp.asarray([1.5, 2.0, 3.0, 50.0])
    confidence, weight = jnp.asarray([1.0, 2.0, 1.0, 9.0]), jnp.asarray([1.0, 0.5, 0.25, 0.0])
    shaped = [jnp.broadcast_to(x, (1, 1, 2, 4)) for x in (values, confidence, truth, weight)]
    loss = dense_loss(shaped[0][..., None], shaped[1], shaped[2][..., None], 0.0, shaped[3])
    expected = (0.5 + 0 + 0.25 - 0.2 * np.log(2)) / 3
    assert float(loss) == pytest.approx(expected, rel=1e-6)
    with_slope = dense_loss(shaped[0][..., None], shaped[1], shaped[2][..., None], 1.0, shaped[3])
    assert float(with_slope) == pytest.approx(expected + (1.0 * 0.5 + 0.25 * 1.0) / 2, rel=1e-6)


def test_a_mirrored_clip_is_a_mirrored_world(clip, found):
    @partial(jax.jit, compiler_options=QUICK)
    def seen(scenes):
        turned = mirrored(clips_of(scenes, PATCH))
        return turned.images, targets(turned), matches(turned, PATCH)

    scenes = jax.tree.map(jnp.asarray, clip)
    images, truth, paired = jax.device_get(seen(scenes))
    plain = jax.device_get(quick_targets(scenes))
    np.testing.assert_array_equal(images, clip.images[:, :, :, ::-1])
    np.testing.assert_allclose(truth.depth, plain.depth[..., ::-1], rtol=1e-5)
    np.testing.assert_allclose(truth.points, plain.points[:, :, :, ::-1] * np.array([-1, 1, 1]), atol=2e-5)

    def turned(values):
        """Of patches whose columns are exchanged."""
        w = clip.depth.shape[3] // PATCH
        return values.reshape(*values.shape[:3], -1, w, *values.shape[4:])[:, :, :, :, ::-1].reshape(values.shape)

    np.testing.assert_allclose(paired.position, turned(found.position) * np.array([-1, 1]), atol=2e-5)
    assert (paired.visible == turned(found.visible)).mean() > 0.999
