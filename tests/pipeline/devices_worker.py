"""What tests/pipeline/test_devices.py runs in a process with several devices: python devices_worker.py OUT [RANK PORT].

Everything is computed on one device and on several, and written into OUT.npz under "what/devices/field". With a rank,
this is one of two processes with half of the devices each. The variables COUNTS and FRAMES have numbers of
devices and of frames.
"""

import os
import sys
from itertools import product

DEVICES = 8
PROCESSES = 2
out, rank = sys.argv[1], None if len(sys.argv) < 3 else int(sys.argv[2])
_count = DEVICES if rank is None else DEVICES // 2 // PROCESSES
_hasty = "--xla_backend_optimization_level=0"  # compiling takes nearly all of the time
os.environ["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={_count} {_hasty}"

os.environ["PJRT_NPROC"] = str(2 * DEVICES)  # of threads: devices that wait for each other hold one each

import flax.linen as nn  # noqa: E402
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

if rank is not None:
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(f"localhost:{sys.argv[3]}", PROCESSES, rank)
jax.config.update("jax_numpy_rank_promotion", "raise")

from tests.shared.tiny import tiny_config  # noqa: E402
from vggtjax import infer, load_clip, reconstruct  # noqa: E402
from vggtjax.config import MotionConfig  # noqa: E402
from vggtjax.network.checkpoint import Model  # noqa: E402
from vggtjax.network.model import init_params  # noqa: E402
from vggtjax.pipeline.devices import frames_mesh  # noqa: E402
from vggtjax.pipeline.run import compile_ahead  # noqa: E402

SIDE = 42
arrays: dict[str, np.ndarray] = {}


def make_model() -> Model:
    """Return a seeded network whose depth and confidence differ from pixel to pixel, not by rounding alone."""
    motion = MotionConfig(cues=MotionConfig().cues[:2])  # a mean and a deviation
    config = tiny_config(image_size=SIDE, motion=motion)
    params = init_params(0, config)
    params["depth_head"]["regression"]["conv2"]["kernel"] *= 50
    return Model(config, params, "tiny")


def images(frames: int) -> np.ndarray:
    """Return noise over which a bright square moves."""
    clip = np.random.default_rng(frames).random((frames, SIDE, SIDE, 3), np.float32)
    for frame in range(frames):
        clip[frame, 8:18, frame : frame + 10] = 1
    return clip


def keep(what: str, devices: int, tree: object) -> None:
    """Keep a tree's arrays under names that the test finds again."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        arrays[f"{what}/{devices}/{jax.tree_util.keystr(path)}"] = np.asarray(leaf)


def keep_result(what: str, devices: int, result) -> None:
    names = ("depth", "depth_confidence", "saliency", "dynamic_mask", "camera_from_world", "intrinsics")
    names += () if result.track_positions is None else ("track_positions", "track_visibility", "track_confidence")
    keep(what, devices, {name: getattr(result, name) for name in names})


def keep_gradient(model: Model, frames: int, devices: int) -> None:
    """Keep what `infer` returns, and the gradient of a sum of all of it, saliency too, by parameters and images.

    METHOD names the method; that of one pass compiles in a third of the time. There is no gradient if it is empty.
    """

    def weighted(params, x):
        method = os.environ.get("METHOD", "4dvggt-d")
        assembly, passes = infer(params, x, model.config, mesh=frames_mesh(devices), method=method)
        leaves = [leaf for leaf in jax.tree.leaves((assembly, passes)) if leaf.dtype != bool]
        weights = [np.random.default_rng(0).normal(size=leaf.shape).astype(np.float32) for leaf in leaves]
        return sum(jnp.mean(w * leaf) for w, leaf in zip(weights, leaves, strict=True)), (assembly, passes)

    differentiated = jax.value_and_grad(weighted, argnums=(0, 1), has_aux=True)
    (_, outputs), gradients = differentiated(model.params, jnp.asarray(images(frames))[None])
    keep(f"infer {frames}", devices, outputs)
    keep(f"gradient {frames}", devices, gradients)


def main() -> None:
    model = make_model()
    all_frames = [int(word) for word in os.environ.get("FRAMES", "13 16").split()]
    counts = [int(word) for word in os.environ.get("COUNTS", "1 2 4 8").split()]
    if rank is not None:
        clip = load_clip(images(all_frames[0]), size=SIDE)
        result = reconstruct(model, clip, devices=jax.device_count(), align_scale=True)
        keep_result("processes", jax.device_count(), result)
        return
    for frames, devices in product(all_frames, counts):
        clip = load_clip(images(frames), size=SIDE)
        needs = compile_ahead(model, frames, SIDE, SIDE, devices=devices, align_scale=True)
        keep(f"memory {frames}", devices, {stage: np.array(need.temporary) for stage, need in needs.items()})
        for stage, need in needs.items():
            by_kind = {kind: np.array(count) for kind, count in need.collectives.items()}
            keep(f"collectives of {stage} {frames}", devices, by_kind)
        keep_result(f"reconstruct {frames}", devices, reconstruct(model, clip, devices=devices, align_scale=True))
    # The slope of a ReLU jumps at 0, where rounding decides the side: gradients are compared through a smooth function.
    nn.relu = nn.gelu
    for frames, devices in product(all_frames, counts):
        if os.environ.get("METHOD", "4dvggt-d"):
            keep_gradient(model, frames, devices)


main()
np.savez(out, **arrays)  # pyright: ignore[reportArgumentType]
