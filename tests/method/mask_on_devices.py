"""What tests/method/test_mask.py runs in a process with several devices: masks, here and on eight devices.

It prints JSON: for each method, the share of dynamic pixels, and whether the masks are equal; of attention in bfloat16,
the largest difference, as a share of the largest value.
"""

import json
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from tests.shared.static_world import GRID, PATCH, StaticWorld
from vggtjax.method.matching.witnesses import Evidence
from vggtjax.method.passes import mine
from vggtjax.network.backbone import ClipBatch, Features
from vggtjax.network.heads.pose import encode_pose
from vggtjax.network.kernels.frames import BY_FRAME, Frames
from vggtjax.network.kernels.gathered_attention import gathered_attention
from vggtjax.network.model import Predictions
from vggtjax.pipeline.devices import frames_mesh, shard_frames, shared_length

COUNT, SIZE = 13, (6, 8)  # frames, which eight devices pad to 16
METHODS = {
    "4dvggt-d": {"smooth_frames": 5},
    "vggt4d": {"clusters": 3, "threshold": "multi-otsu"},
    "vggt4d without clusters": {"threshold": "multi-otsu"},  # which hide the range of the frames that are added
}

mesh = frames_mesh(8)
real, found = Frames(mesh, COUNT), {}


def mined(evidence: Any, first: Any, tokens: Any, images: Any, how: dict[str, Any], frames: Frames = Frames()) -> Any:
    return mine(evidence, first, ClipBatch(images, Features(tokens)), **how, frames=frames)


def compare(method: str, how: dict[str, Any], *inputs: Any) -> Any:
    """Mine a clip on one device, and padded on eight."""
    alone: Any = jax.jit(partial(mined, how=how))(*inputs)
    added = shared_length(COUNT, mesh) - COUNT
    padded = jax.tree.map(lambda x: np.pad(x, ((0, 0), (0, added), *((0, 0),) * (x.ndim - 2)), mode="edge"), inputs)
    shared: Any = jax.jit(partial(mined, how=how, frames=real))(*shard_frames(padded, mesh))
    pairs = zip(*map(jax.tree.leaves, (alone, shared)), strict=True)
    is_equal = (
        all(np.allclose(a, b[:, :COUNT], atol=1e-4) for a, b in pairs) and not shared.dynamic_mask[:, COUNT:].any()
    )
    found[method] = float(np.mean(alone.dynamic_mask)), bool(is_equal)
    return alone


generator = np.random.default_rng(0)
saliency = generator.random((1, COUNT, *SIZE)).astype(np.float32)
saliency[:, :, :2, 1:3] += 1
tokens = saliency.reshape(1, -1, 48, 1) + generator.normal(0, 0.01, (1, COUNT, 48, 3)).astype(np.float32)
pictures = generator.random((1, COUNT, *SIZE, 3)).astype(np.float32)
for method, options in METHODS.items():
    compare(
        method, {"clusters": 0, "threshold": "otsu"} | options, Evidence(jnp.asarray(saliency)), None, tokens, pictures
    )

world = StaticWorld(COUNT)
moves = np.zeros((COUNT, *GRID), bool)
moves[:, 2:4, 1:3] = True
depth, moving = (np.kron(x.reshape(-1, *GRID), np.ones((1, PATCH, PATCH), x.dtype)) for x in (world.depth, moves))
sides = (GRID[0] * PATCH, GRID[1] * PATCH)
intrinsics = world.cameras.intrinsics * np.array([[PATCH], [PATCH], [1]], np.float32)
pose = np.asarray(encode_pose(world.cameras.camera_from_world, intrinsics, sides))
images = np.random.default_rng(0).random((COUNT, *depth.shape[1:], 3)).astype(np.float32) / 20 + moving[..., None] / 2
images += np.linspace(0, 0.3, COUNT, dtype=np.float32)[:, None, None, None]  # not one picture many times
matches = jax.tree.map(lambda x: np.asarray(x)[None], world.matches(moves.reshape(COUNT, -1)))
evidence = Evidence(jnp.full((1, *moves.shape), 0.5), matches)
first = Predictions(jnp.asarray(pose)[None], jnp.asarray(depth, jnp.float32)[None])
features = np.zeros((1, COUNT, GRID[0] * GRID[1], 3), np.float32)
how = {"clusters": 0, "threshold": "otsu"}
alone = compare("4dvggt-m", how, evidence, first, features, images[None].astype(np.float32))
assert alone.is_matched.all()

q, k, v = (
    jax.random.normal(key, (1, 8 * 60, 4, 16)).astype(jnp.bfloat16) for key in jax.random.split(jax.random.key(0), 3)
)
frames = Frames(mesh)
alone = jax.jit(partial(gathered_attention, visible=None, frames=Frames()))(q, k, v)
attend = frames.on_devices(partial(gathered_attention, visible=None, frames=frames), *(BY_FRAME,) * 3)
difference = jnp.abs(jax.jit(attend)(q, k, v).astype(jnp.float32) - alone.astype(jnp.float32)) / jnp.abs(alone).max()
found["attention in bfloat16"] = float(difference.max()), alone.dtype == jnp.bfloat16
print(json.dumps(found))  # noqa: T201
