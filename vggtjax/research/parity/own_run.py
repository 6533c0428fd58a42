"""This library's passes on the frames of a check, and what must hold of them alone."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vggtjax.clips.clip import load_clip
from vggtjax.errors import InputError, whole_number
from vggtjax.method.mask import dynamic_tokens
from vggtjax.network.checkpoint import Model
from vggtjax.network.heads.pose import decode_pose
from vggtjax.network.model import Predictions, forward
from vggtjax.pipeline.pretrained.embedded import demo_clip
from vggtjax.research.parity.outputs import CAMERAS, MASKED, OUTPUTS, Arrays

_ORTHONORMAL = 1e-5  # of R R^T
_PLACES = (0.2, 0.5, 0.8)  # of the tracked points, as shares of the width and of the height
_MASKED_OUTPUTS = ("camera", "depth", "points")


class Frames(NamedTuple):
    """What both sides read."""

    images: np.ndarray  # [S, H, W, 3] in [0, 1]
    queries: np.ndarray  # [Q, 2], x and y in pixels of the first frame
    mask: np.ndarray  # [S, H, W], true on what moves


class Check(NamedTuple):
    """Something that must hold of a model alone."""

    name: str
    found: str
    holds: bool


def demo_frames(model: Model, count: int) -> Frames:
    """Return frames of the embedded clip, spread over it, at the model's own size, and its mask.

    Raises InputError unless `count` is from 1 to the number of frames of the clip.
    """
    truth, size = demo_clip(), model.config.clip_size
    total = len(truth.images)
    if whole_number("frames", count, 1) > total:
        raise InputError(f"frames is {count}; expected at most the {total} of the embedded clip")
    chosen = np.linspace(0, total - 1, count).astype(int)
    images = load_clip(truth.images[chosen], model=model, size=size).images
    H, W = images.shape[1:3]
    mask = truth.dynamic_mask[chosen]
    rows, columns = (np.arange(n) * old // n for n, old in zip((H, W), mask.shape[1:], strict=True))
    queries = np.array([(x * W, y * H) for y in _PLACES for x in _PLACES], np.float32)
    return Frames(np.asarray(images, np.float32), queries, mask[:, rows][:, :, columns])


def run_own(model: Model, frames: Frames, *, masked: bool) -> tuple[Arrays, float, bool]:
    """Run our passes; return the outputs, the seconds of a plain pass, and whether a second one equals the first.

    Everything is float32, products too. The first pass also compiles; the second one is timed.
    """
    config, images = model.config, frames.images[None]
    tracked = {"query_points": frames.queries[None]} if "tracks" in config.heads else {}
    plain = jax.jit(partial(forward, config=config, outputs=config.heads))
    run = partial(plain, model.params, images, **tracked)
    first = _arrays(run(), images.shape[2:4])
    began = time.perf_counter()
    second = _arrays(run(), images.shape[2:4])
    seconds = time.perf_counter() - began
    equal = all(np.array_equal(first[name], second[name], equal_nan=True) for name in first)
    if masked:
        outputs = tuple(name for name in _MASKED_OUTPUTS if name in config.heads)
        tokens = dynamic_tokens(jnp.asarray(frames.mask[None]), config.patch_size)
        second_pass = jax.jit(partial(forward, config=config, outputs=outputs, suppress="drop"))
        first |= _arrays(second_pass(model.params, images, dynamic_tokens=tokens), images.shape[2:4], MASKED)
    return first, seconds, equal


def _arrays(made: Predictions, size: tuple[int, int], prefix: str = "") -> Arrays:
    names = (*OUTPUTS, "rays", "rays_confidence")  # VGGT's public code has none of these two
    arrays = {name: getattr(made, name) for name in names if getattr(made, name) is not None}
    if made.pose_encoding is not None:
        arrays[CAMERAS] = decode_pose(made.pose_encoding, size)[0]
    return {prefix + name: np.asarray(array[0], np.float32) for name, array in arrays.items()}


def checks(made: Arrays, equal: bool) -> list[Check]:
    """Return what must hold of the outputs of a model, whatever its weights."""
    values = sum(array.size for array in made.values())
    finite = sum(int(np.isfinite(array).sum()) for array in made.values())
    found = [Check("all outputs are finite", f"{finite} of {values} values", finite == values)]
    holds: Callable[[str, float, bool], Check] = lambda name, x, ok: Check(name, f"{x:.2g}", bool(ok))  # noqa: E731
    if "depth" in made:
        found.append(holds("depth is positive: its minimum", made["depth"].min(), made["depth"].min() > 0))
    if CAMERAS in made:
        rotation = made[CAMERAS][..., :3].astype(np.float64)
        apart = np.abs(rotation @ rotation.swapaxes(-1, -2) - np.eye(3)).max()
        upright = (np.linalg.det(rotation) > 0).all() if np.isfinite(rotation).all() else False
        found.append(holds("rotations are orthonormal: largest error", apart, apart <= _ORTHONORMAL and upright))
    found.append(Check("a second pass equals the first", "bit by bit" if equal else "it differs", equal))
    return found
