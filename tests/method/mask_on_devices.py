"""What tests/method/test_mask.py runs in a process with several devices: masks, here and on eight devices.

It prints JSON: for each method, the share of dynamic pixels, and whether the masks are equal; of attention in bfloat16,
the largest difference, as a share of the largest value.
"""

import json
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from tests.static_world import GRID, PATCH, StaticWorld
from vggtjax.method.mask import mine_mask
from vggtjax.method.matched_mask import mine_matched_mask
from vggtjax.network.frames import BY_FRAME, Frames
from vggtjax.network.gathered_attention import gathered_attention
from vggtjax.network.pose import encode_pose
from vggtjax.pipeline.devices import frames_mesh
from vggtjax.pipeline.lengths import shared_length

COUNT, SIZE = 13, (6, 8)  # frames, which eight devices pad to 16
METHODS = {
    "4dvggt-d": {"smooth_frames": 5},
    "vggt4d": {"clusters": 3, "threshold": "multi-otsu"},
    "vggt4d without clusters": {"threshold": "multi-otsu"},  # which hide the range of the frames that are added
}

mesh = frames_mesh(8)
generator = np.random.default_rng(0)
saliency = generator.random((1, shared_length(COUNT, mesh), *SIZE)).astype(np.float32)
saliency[:, :, :2, 1:3] += 1
saliency[:, COUNT:] = 40 * saliency[:, COUNT:] - 20  # of the frames that are added
tokens = saliency.reshape(1, -1, 48, 1) + generator.normal(0, 0.01, (1, saliency.shape[1], 48, 3)).astype(np.float32)
found = {}
for method, options in METHODS.items():
    alone = jax.jit(partial(mine_mask, size=SIZE, **options))(
        jnp.asarray(saliency[:, :COUNT]), jnp.asarray(tokens[:, :COUNT])
    )
    frames = Frames(mesh, COUNT)
    mine = frames.on_devices(partial(mine_mask, size=SIZE, frames=frames, **options), BY_FRAME, BY_FRAME)
    shared = np.asarray(jax.jit(mine)(jnp.asarray(saliency), jnp.asarray(tokens)))
    is_equal = np.array_equal(shared[:, :COUNT], alone) and not shared[:, COUNT:].any()
    found[method] = float(np.mean(alone)), bool(is_equal)


def by_matches(frames, depth, cameras, matches, gram_mask, saliency, images):
    pose_encoding = encode_pose(cameras.camera_from_world, cameras.intrinsics, (GRID[0] * PATCH, GRID[1] * PATCH))
    return mine_matched_mask(matches, gram_mask, saliency, images, depth, pose_encoding, frames=frames)


world = StaticWorld(COUNT)
moves = np.zeros((COUNT, *GRID), bool)
moves[:, 2:4, 1:3] = True
depth, moving = (np.kron(x.reshape(-1, *GRID), np.ones((1, PATCH, PATCH), x.dtype)) for x in (world.depth, moves))
cameras = world.cameras._replace(intrinsics=world.cameras.intrinsics * np.array([[PATCH], [PATCH], [1]], np.float32))
images = np.random.default_rng(0).random((COUNT, *depth.shape[1:], 3)).astype(np.float32) / 20 + moving[..., None] / 2
inputs = (depth.astype(np.float32), cameras, world.matches(moves.reshape(COUNT, -1)), moving & False)
inputs += (np.full(moves.shape, 0.5, np.float32), images.astype(np.float32))
alone = jax.jit(partial(by_matches, Frames()))(*jax.tree.map(lambda x: jnp.asarray(x)[None], inputs))
frames, added = Frames(mesh, COUNT), shared_length(COUNT, mesh) - COUNT
padded = jax.tree.map(lambda x: np.pad(x, ((0, added), *((0, 0),) * (x.ndim - 1)), mode="edge")[None], inputs)
shared = jax.jit(frames.on_devices(partial(by_matches, frames), *(BY_FRAME,) * 6))(*padded)
is_equal = all(
    np.allclose(a, b[:, :COUNT], atol=1e-4) for a, b in zip(*map(jax.tree.leaves, (alone, shared)), strict=True)
)
found["4dvggt-m"] = float(np.mean(alone.dynamic_mask)), is_equal and bool(alone.is_matched.all())

q, k, v = (
    jax.random.normal(key, (1, 8 * 60, 4, 16)).astype(jnp.bfloat16) for key in jax.random.split(jax.random.key(0), 3)
)
frames = Frames(mesh)
alone = jax.jit(partial(gathered_attention, visible=None, frames=Frames()))(q, k, v)
attend = frames.on_devices(partial(gathered_attention, visible=None, frames=frames), *(BY_FRAME,) * 3)
difference = jnp.abs(jax.jit(attend)(q, k, v).astype(jnp.float32) - alone.astype(jnp.float32)) / jnp.abs(alone).max()
found["attention in bfloat16"] = float(difference.max()), alone.dtype == jnp.bfloat16
print(json.dumps(found))  # noqa: T201
