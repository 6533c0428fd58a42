"""What tests/pipeline/test_devices.py runs in a process with several devices: python devices_worker.py OUT [RANK PORT].

Everything is computed on one device and on several, and written into OUT.npz under "what/devices/field". With a rank,
this is one of two processes with half of the devices each. The variable COUNTS has the numbers of devices.
"""

import os
import sys

DEVICES = 8
PROCESSES = 2
out, rank = sys.argv[1], None if len(sys.argv) < 3 else int(sys.argv[2])
os.environ["XLA_FLAGS"] = " ".join(
    [
        f"--xla_force_host_platform_device_count={DEVICES if rank is None else DEVICES // 2 // PROCESSES}",
        "--xla_backend_optimization_level=0",  # compiling takes nearly all of the time
    ]
)

import jax  # noqa: E402
import numpy as np  # noqa: E402

if rank is not None:
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(f"localhost:{sys.argv[3]}", PROCESSES, rank)
jax.config.update("jax_numpy_rank_promotion", "raise")

from tests.tiny import tiny_config  # noqa: E402
from vggtjax import Model, compile_ahead, load_clip, reconstruct  # noqa: E402
from vggtjax.config import MotionConfig  # noqa: E402
from vggtjax.network.model import init_params  # noqa: E402

SIDE = 42
arrays: dict[str, np.ndarray] = {}


def make_model() -> Model:
    """Return a seeded network whose depth and confidence differ from pixel to pixel, not by rounding alone."""
    track = {"track_corr_levels": 2, "track_corr_radius": 1, "track_features": 8, "track_hidden": 16}
    motion = MotionConfig(cues=MotionConfig().cues[:2])  # a mean and a deviation
    config = tiny_config(image_size=SIDE, motion=motion, **track)
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


def main() -> None:
    model = make_model()
    clip = load_clip(images(13), size=SIDE)
    if rank is not None:
        result = reconstruct(model, clip, devices=jax.device_count(), align_scale=True)
        keep_result("processes", jax.device_count(), result)
        return
    for devices in map(int, os.environ.get("COUNTS", "1 2 4 8").split()):
        needs = compile_ahead(model, 13, SIDE, SIDE, devices=devices, align_scale=True)
        keep("memory", devices, {stage: np.array(need.temporary) for stage, need in needs.items()})
        for stage, need in needs.items():
            counts = {kind: np.array(count) for kind, count in need.collectives.items()}
            keep(f"collectives of {stage}", devices, counts)
        keep_result("reconstruct 13", devices, reconstruct(model, clip, devices=devices, align_scale=True))


main()
np.savez(out, **arrays)  # pyright: ignore[reportArgumentType]
