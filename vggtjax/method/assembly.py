"""Two passes -> a method's depth, confidence and cameras: surgery and region-aware fusion (4DVGGT-D, stage 3)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Array, Float

from vggtjax.cameras import Cameras
from vggtjax.errors import InputError
from vggtjax.method.fusion.family import FusionParams, Observations, fuse, paper_rule
from vggtjax.method.fusion.inputs import observe
from vggtjax.method.fusion.rule import fuse_depth, replace_depth, scale_between
from vggtjax.method.passes import Passes, present
from vggtjax.network.heads.pose import decode_pose
from vggtjax.network.kernels.frames import Frames
from vggtjax.options import METHODS, find_method

Depth = Float[Array, "B S H W"]

# A fitted tree of the family, or a function from what is seen of the pixels to depth and precision. `Partial` is a
# function whose bound arguments are arrays: weights that jit traces and that have gradients.
FusionRule = FusionParams | Callable[[Observations], tuple[Depth, Depth]]


def as_tree(fusion: FusionRule | None) -> FusionParams | Partial | None:
    """Return a rule of fusion as a tree of arrays: a function becomes a `Partial` without any."""
    return Partial(fusion) if callable(fusion) and not isinstance(fusion, Partial) else fusion  # type: ignore[return-value]


def check_fuses(fusion: FusionRule | None, *methods: str) -> None:
    """Raise InputError if a rule of fusion is given and none of the methods fuses both passes."""
    if isinstance(fusion, str):
        raise InputError(f"fusion is {fusion!r}; expected a rule of fusion; a method's name is given as method=")
    if fusion is not None and all(find_method(method).depth != "fused" for method in methods):
        names = ", ".join(name for name, row in METHODS.items() if row.depth == "fused")
        raise InputError(f"a fusion is given, and method {methods[0]!r} does not fuse; expected {names}")


class Assembly(NamedTuple):
    """A method's result: depth up to scale, its confidence, and the cameras."""

    depth: Depth
    confidence: Depth
    cameras: Cameras

    @property
    def camera_from_world(self) -> Float[Array, "B S 3 4"]:
        return self.cameras.camera_from_world

    @property
    def intrinsics(self) -> Float[Array, "B S 3 3"]:
        return self.cameras.intrinsics


def assemble(
    passes: Passes,
    fusion: FusionRule | None = None,
    *,
    method: str = "4dvggt-d",
    align_scale: bool = False,
    frames: Frames = Frames(),
) -> Assembly:
    """Return a method's depth, confidence and cameras from two passes; the methods of `ABLATION` share one run of them.

    Args:
        passes: of `run_passes` with this method's options; passes of another method give a wrong result, not an error.
        fusion: a rule of fusion in place of the paper's: a fitted tree, or a function of `Observations` (of
            `method.fusion.family`) that returns depth and precision, of the same shape. The precision becomes the
            confidence.
        method: a name of `METHODS`.
        align_scale: scale the second pass (depth and camera translations) by the median depth ratio over static
            pixels before it is used. Not in the paper.
        frames: where the frames of the passes are; those after `frames.count` are left out.
    """
    row = find_method(method)
    check_fuses(fusion, method)
    if passes.second is None and row.needs_second_pass:
        raise InputError(f"method {method!r} needs the second pass, which was not run")
    passes = frames.whole(passes)
    first, second = passes.first, passes.second or passes.first
    scale = None
    if align_scale and passes.second is not None:
        scale = scale_between(present(first.depth), present(second.depth), passes.dynamic_mask)
    if fusion is None and row.depth == "fused" and passes.dynamic_mask.dtype != bool:
        fusion = paper_rule()  # of `fuse_depth`, written for shares
    if fusion is None:
        depth, confidence = _depth(passes, row.depth, scale)
    else:
        depth, confidence = _by_rule(fusion, observe(passes, scale=scale))
    size = (depth.shape[2], depth.shape[3])
    extrinsics, intrinsics = decode_pose(present(second.pose_encoding), size)
    of_second = extrinsics if scale is None else extrinsics.at[..., 3].multiply(scale[:, None, None])
    of_pass = {
        "first": Cameras(*decode_pose(present(first.pose_encoding), size)),
        "second": Cameras(of_second, intrinsics),
    }
    chosen = Cameras(of_pass[row.extrinsics].camera_from_world, of_pass[row.intrinsics].intrinsics)
    return Assembly(depth, confidence, chosen)


def _depth(passes: Passes, source: str, scale: Float[Array, " B"] | None) -> tuple[Depth, Depth]:
    """Return depth and confidence by the paper's rule for a method's source of depth."""
    first, second = passes.first, passes.second or passes.first

    def of_first() -> tuple[Array, Array]:
        return present(first.depth), present(first.depth_confidence)

    def of_second() -> tuple[Array, Array]:
        depth = present(second.depth)
        return depth if scale is None else depth * scale[:, None, None, None], present(second.depth_confidence)

    if source == "first":
        return of_first()
    if source == "second":
        return of_second()
    join = {"replaced": replace_depth, "fused": fuse_depth}[source]
    return join(*of_first(), *of_second(), passes.dynamic_mask)


def _by_rule(fusion: FusionRule, seen: Observations) -> tuple[Depth, Depth]:
    if not callable(fusion):
        fused = fuse(fusion, seen)
        return fused.depth, fused.precision
    made: Any = fusion(seen)
    is_pair = isinstance(made, tuple) and len(made) == 2
    if not is_pair or any(jnp.shape(array) != seen.depth1.shape for array in made):
        shapes = [str(jnp.shape(array)) for array in jax.tree.leaves(made)]
        returned = f"{len(shapes)} array{'' if len(shapes) == 1 else 's'} of shape {' and '.join(shapes)}"
        raise InputError(
            f"the rule of fusion returned {returned}; expected a pair (depth, precision), both of shape "
            f"{seen.depth1.shape}"
        )
    return made
