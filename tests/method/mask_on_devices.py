"""What tests/method/test_mask.py runs in a process with several devices: masks, here and on eight devices.

It prints JSON: for each method, the share of dynamic pixels, and whether the masks are equal.
"""

import json
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from vggtjax.method.mask import mine_mask
from vggtjax.network.frames import BY_FRAME, Frames
from vggtjax.pipeline.devices import frames_mesh, shared_length

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
print(json.dumps(found))  # noqa: T201
