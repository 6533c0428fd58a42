"""A batch of clips -> a method's depth and cameras, as one compiled function."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.sharding import Mesh
from jaxtyping import Array, Float

from vggtjax.config import MotionConfig, VGGTConfig
from vggtjax.errors import InputError
from vggtjax.method.passes import Assembly, Passes
from vggtjax.network.layers import Params
from vggtjax.options import Options
from vggtjax.pipeline.devices import placed
from vggtjax.pipeline.stage_runners import inline
from vggtjax.pipeline.stages import ClipInputs, Stages, run_stages

_SLACK = 1e-3  # largest distance of a value from [0, 1] that counts as rounding


def infer(
    params: Params,
    images: Float[Array, "B S H W 3"],
    config: VGGTConfig,
    *,
    options: Options = Options(),
    motion: MotionConfig | None = None,
    mesh: Mesh | None = None,
    **changes: Any,
) -> tuple[Assembly, Passes]:
    """Run a method on a batch of clips as one compiled function.

    Args:
        params: the model's parameter tree.
        images: RGB in [0, 1]; H and W are multiples of the patch size. Floats outside [0, 1] are refused, unless the
            call is traced by jit.
        config: the model's configuration.
        options: how the clips are reconstructed; masks are not refined.
        motion: the table of motion cues; the configuration's own if None.
        mesh: devices along an axis "frames" that share the frames (`frames_mesh`); None for one device.
        changes: fields of `options` by name, such as `method="vggt4d"`.

    Returns:
        The method's depth, confidence and cameras, and the passes they were made of. The mask of a clip whose frames
        are all one picture is empty.
    """
    _check_range(images)
    config = config if motion is None else dataclasses.replace(config, motion=motion)
    # Equal programs have equal options: the method's own values are filled in, and masks are not refined here.
    options = dataclasses.replace(options.changed(**changes).resolved(config.motion), refine_mask=False)
    if mesh is None:
        return _infer(params, images, config, options, images.shape[1], None)
    frames = images.shape[1]
    params, images = placed(params, images, mesh)
    outputs = _infer(params, images, config, options, frames, mesh)
    return outputs if images.shape[1] == frames else jax.tree.map(lambda x: x[:, :frames], outputs)


def _check_range(images: Float[Array, "B S H W 3"]) -> None:
    """Raise InputError for values outside [0, 1]; they are unknown while jit traces."""
    if isinstance(images, Tracer) or not images.size or not jnp.issubdtype(images.dtype, jnp.floating):
        return
    library = np if isinstance(images, np.ndarray) else jnp
    low, high = float(library.min(images)), float(library.max(images))
    if not (low >= -_SLACK and high <= 1 + _SLACK):  # so NaN, too, is refused
        raise InputError(f"images have values from {low:g} to {high:g}; expected RGB in [0, 1]: divide bytes by 255")


@partial(jax.jit, static_argnames=("config", "options", "frames", "mesh"))
def _infer(
    params: Params, images: Array, config: VGGTConfig, options: Options, frames: int, mesh: Mesh | None
) -> tuple[Assembly, Passes]:
    stages = Stages(config, options, frames, (images.shape[2], images.shape[3]), run=inline, mesh=mesh)
    passes, assembly, _ = run_stages(stages, params, ClipInputs(images))
    return assembly, passes
