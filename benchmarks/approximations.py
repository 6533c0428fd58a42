"""Errors and speed of cheaper global attention, against exact: python -m benchmarks approximations."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from rich.console import Console
from rich.table import Table

from vggtjax.cameras import unproject
from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError
from vggtjax.network.aggregator import GLOBAL_ATTENTION, SPECIAL_TOKENS
from vggtjax.network.block import Block, apply_block
from vggtjax.network.checkpoint import Model
from vggtjax.network.heads.pose import decode_pose
from vggtjax.network.kernels.quantised import is_quantised, quantise
from vggtjax.network.layers import Params
from vggtjax.network.model import forward
from vggtjax.network.precision import full_precision
from vggtjax.network.rope import rope_table
from vggtjax.pipeline.pretrained.load import load_model
from vggtjax.research.evaluation.metrics.depth import median_scale
from vggtjax.research.evaluation.metrics.trajectory import centre_error, rotation_error
from vggtjax.storage.kept_memory import keep_freed_memory
from vggtjax.training.scenes import SceneConfig, held_out_scenes

WAYS: dict[str, str] = {
    "exact": "exact",
    "sampled": "sampled",
    "exact, int8 weights": "exact",
}
_HEADS, _WIDTH = 16, 1024
_SEED = 3  # of the scenes


def approximations(
    *,
    model: str = "demo",
    scenes: int = 16,
    frames: tuple[int, ...] = (16, 32),
    speed: tuple[int, ...] = (2, 4, 8, 16),
    height: int = 294,
    width: int = 518,
    repeats: int = 2,
) -> None:
    """Measure errors of a plain pass and the time of blocks, with exact global attention and its approximations.

    Args:
        model: "demo", or weights as for vggtjax reconstruct.
        scenes: held-out dynamic scenes.
        frames: numbers of frames of the scenes, at least 12; () for no errors.
        speed: numbers of frames of which blocks of VGGT-1B's width are timed; () for no times.
        height: of those frames, in pixels.
        width: of those frames, in pixels.
        repeats: timed runs of each; the fastest counts.
    """
    if min(scenes, repeats) < 1:
        raise InputError(f"scenes and repeats are {scenes} and {repeats}; expected at least 1")
    keep_freed_memory()
    console = Console()
    console.width = max(console.width, 120)  # rich assumes 80 for a file
    if frames:
        loaded = load_model(model)
        for count in frames:
            console.print(_errors(loaded, count, scenes))
    for count in speed:
        console.print(_times(count, (height // 14, width // 14), repeats))


def _weights(name: str, params: Params, prefix: str = "") -> Params:
    """Return the weights of a way, in 8 bits if its name says so; `prefix` goes before the names of parameters."""
    if not name.endswith("int8 weights"):
        return params
    flat = flatten_dict(params, sep=".")
    rounded = {key: quantise(np.asarray(leaf)) if is_quantised(prefix + key) else leaf for key, leaf in flat.items()}
    return unflatten_dict(rounded, sep=".")


def _run(params: Params, images: Any, config: VGGTConfig, way: str) -> Callable[..., Any]:
    compute: Any = {"attention": way}
    return jax.jit(lambda params, images: forward(params, images, config, **compute)).lower(params, images).compile()


def _errors(model: Model, frames: int, scenes: int) -> Table:
    config, side = model.config, model.config.image_size
    clips = held_out_scenes("dynamic", scenes, SceneConfig(height=side, width=side, frames=frames), seed=_SEED)
    table = Table(title=f"{scenes} scenes of {frames} frames of {side} x {side} pixels", box=None)
    for heading in ("attention", "depth", "rotation", "centres", "depth to exact", "rotation", "points"):
        table.add_column(heading, justify="left" if heading == "attention" else "right")
    exact: list[tuple] = []
    for name, way in WAYS.items():
        params = _weights(name, model.params)
        run = _run(params, jnp.asarray(clips.images[:1]), config, way)
        outputs, rows = [], []
        for index in range(scenes):
            predictions = run(params, jnp.asarray(clips.images[index : index + 1]))
            cameras, intrinsics = decode_pose(predictions.pose_encoding, (side, side))
            outputs.append(tuple(np.asarray(x[0]) for x in (predictions.depth, cameras, intrinsics)))
            truth = (clips.depth[index], clips.camera_from_world[index])
            to_exact = (exact or outputs)[index]
            rows.append((*_apart(outputs[-1], truth), *_apart(outputs[-1], to_exact), _points(outputs[-1], to_exact)))
        exact = exact or outputs
        depth, rotation, centres, to_depth, to_rotation, _, points = np.mean(rows, axis=0)
        cells = (f"{depth:.3f}", f"{rotation:.2f}°", f"{centres:.4f}", f"{to_depth:.2%}", f"{to_rotation:.2f}°")
        table.add_row(name, *cells, f"{points:.2%}")
    table.caption = (
        "to the truth, means over scenes: median relative error of depth after its median scale, rotations, centres in "
        "median depths; to exact: mean relative difference of depth, rotations, median distance of points in median "
        "depths"
    )
    return table


def _apart(outputs: tuple, others: tuple) -> tuple[float, float, float]:
    """Return the difference of depth, of rotations in degrees, and of centres in median depths.

    Depth of the truth is compared by its median error, as a few pixels of it are near 0; that of exact by the mean.
    """
    (depth, cameras), (other, other_cameras) = outputs[:2], others[:2]
    relative = np.abs(depth * median_scale(depth, other) - other) / other
    error = np.median(relative) if len(others) == 2 else relative.mean()
    centres = centre_error(cameras, other_cameras) / np.median(other)
    return float(error), rotation_error(cameras, other_cameras), float(centres)


def _points(outputs: tuple, others: tuple) -> float:
    """Return the median distance of the points of each pixel, in median depths, after the median scale of depth."""
    scale = median_scale(outputs[0], others[0])
    ours, theirs = (unproject(depth, k, cameras, pixel_offset=0.5) for depth, cameras, k in (outputs, others))
    return float(
        np.median(np.linalg.norm(scale * np.asarray(ours) - np.asarray(theirs), axis=-1)) / np.median(others[0])
    )


def _times(frames: int, grid: tuple[int, int], repeats: int) -> Table:
    """Time a block of VGGT-1B's width over each frame, and over all frames with each way."""
    tokens = SPECIAL_TOKENS + grid[0] * grid[1]
    generator = np.random.default_rng(0)
    block = Block(_HEADS, qk_norm=True)
    shapes = jax.eval_shape(block.init, jax.random.key(0), jnp.zeros((1, 1, _WIDTH)))["params"]
    params = jax.tree.map(lambda leaf: jnp.asarray(0.03 * generator.standard_normal(leaf.shape, np.float32)), shapes)
    x = jnp.asarray(generator.standard_normal((frames, tokens, _WIDTH), np.float32))
    rope = rope_table(grid, SPECIAL_TOKENS, _WIDTH // _HEADS)

    def compiled(name: str, way: Callable | None) -> Callable[[], Any]:
        def run(params, x):
            if way is None:
                return apply_block(block, params, x, rope)[0]
            attend = way(frames, grid, SPECIAL_TOKENS)
            return apply_block(block.clone(attend=attend), params, x.reshape(1, -1, _WIDTH), rope)[0]

        inputs = _weights(name, params, "aggregator.global_blocks."), x
        return partial(jax.jit(full_precision(run)).lower(*inputs).compile(), *inputs)

    ways = {"a frame": None} | {name: GLOBAL_ATTENTION[way] for name, way in WAYS.items()}
    programs = {name: compiled(name, way) for name, way in ways.items()}
    best = dict.fromkeys(programs, (np.inf, np.inf))
    for repeat in range(repeats + 1):
        for name, program in programs.items():
            began, worked = time.perf_counter(), time.process_time()
            jax.block_until_ready(program())
            if repeat:  # the first is a warm-up
                spent = (time.perf_counter() - began, time.process_time() - worked)
                best[name] = min(best[name][0], spent[0]), min(best[name][1], spent[1])
    table = Table(title=f"{frames} frames of {tokens} tokens, {_WIDTH} channels, float32", box=None)
    for heading in ("attention", "global block, s", "processor s", "ratio", "72 blocks, processor s", "ratio"):
        table.add_column(heading, justify="left" if heading == "attention" else "right")
    frame = best.pop("a frame")
    whole = {name: 24 * (2 * frame[1] + spent[1]) for name, spent in best.items()}
    for name, (wall, worked) in best.items():
        faster = (f"{best['exact'][1] / worked:.2f}", f"{whole[name]:.0f}", f"{whole['exact'] / whole[name]:.2f}")
        table.add_row(name, f"{wall:.2f}", f"{worked:.2f}", *faster)
    table.caption = "72 blocks: 24 global ones, and 48 by the time of one over each frame"
    return table
