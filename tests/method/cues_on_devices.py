"""What tests/method/test_cues.py runs in a process with several devices: the sums of cues, here and on eight devices.

It prints JSON: for each number of frames, how far each sum on eight devices is off, as a share of its range.
"""

import json

import jax
import jax.numpy as jnp
import numpy as np

from vggtjax.config import Cue, MotionConfig
from vggtjax.method.cues import GramCues
from vggtjax.network.frames import BY_FRAME, Frames
from vggtjax.pipeline.devices import frames_mesh, shared_length

HEADS, CHANNELS, SPECIAL, PATCHES = 2, 4, 3, 6
MOTION = MotionConfig(
    cues=(
        Cue("means", rows="q", columns="k", layers=(0, 1), statistic="mean"),
        Cue("deviation", rows="q", columns="q", layers=(1,), statistic="std"),
        Cue("deviations", rows="k", columns="q", layers=(0, 1), statistic="std"),
    ),
    offsets=(-4, -1, 2),
)


def sums(frames: Frames, q, k):
    """Return the sums of all cues after two pairs of blocks."""
    cues = GramCues(MOTION, depth=2, frames=frames)

    def run(q, k):
        total = frames.varying(cues.zeros(1, q.shape[1], PATCHES))
        return jax.lax.scan(
            lambda total, count: (cues.add(total, count, q, k), None), total, jnp.asarray(cues.layer_counts())
        )[0]

    return jax.jit(frames.on_devices(run, BY_FRAME, BY_FRAME))(q, k)


off = {}
for count in (5, 13, 24):  # one, two and three frames a device: of all devices, or of near ones; 5 and 13 are padded
    mesh = frames_mesh(8)
    shape = 1, shared_length(count, mesh), SPECIAL + PATCHES, HEADS, CHANNELS
    q, k = np.random.default_rng(count).normal(size=(2, *shape)).astype(np.float32)
    here = sums(Frames(), jnp.asarray(q[:, :count]), jnp.asarray(k[:, :count]))
    shared = sums(Frames(mesh, count), jnp.asarray(q), jnp.asarray(k))
    off[count] = [
        float(np.abs(np.asarray(there)[:, :count] - one).max() / np.ptp(one))
        for one, there in zip(map(np.asarray, here), shared, strict=True)
    ]
print(json.dumps(off))  # noqa: T201
