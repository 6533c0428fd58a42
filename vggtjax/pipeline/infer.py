"""A batch of clips -> a method's depth and cameras, as one compiled function."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
from jax.sharding import Mesh
from jaxtyping import Array, Float

from vggtjax.config import MotionConfig, VGGTConfig
from vggtjax.method.passes import Assembly, Passes
from vggtjax.network.layers import Params
from vggtjax.options import Options
from vggtjax.pipeline.devices import placed
from vggtjax.pipeline.stage_runners import inline
from vggtjax.pipeline.stages import ClipInputs, Stages, run_stages


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
        images: RGB in [0, 1]; H and W are multiples of the patch size.
        config: the model's configuration.
        options: how the clips are reconstructed; masks are not refined.
        motion: the table of motion cues; the configuration's own if None.
        mesh: devices along an axis "frames" that share the frames (`frames_mesh`); None for one device.
        changes: fields of `options` by name, such as `method="vggt4d"`.

    Returns:
        The method's depth, confidence and cameras, and the passes they were made of. The mask of a clip whose frames
        are all one picture is empty.
    """
    config = config if motion is None else dataclasses.replace(config, motion=motion)
    # Equal programs have equal options: the method's own values are filled in, and masks are not refined here.
    options = dataclasses.replace(options.changed(**changes).resolved(config.motion), refine_mask=False)
    if mesh is None:
        return _infer(params, images, config, options, images.shape[1], None)
    frames = images.shape[1]
    params, images = placed(params, images, mesh)
    outputs = _infer(params, images, config, options, frames, mesh)
    return outputs if images.shape[1] == frames else jax.tree.map(lambda x: x[:, :frames], outputs)


@partial(jax.jit, static_argnames=("config", "options", "frames", "mesh"))
def _infer(
    params: Params, images: Array, config: VGGTConfig, options: Options, frames: int, mesh: Mesh | None
) -> tuple[Assembly, Passes]:
    stages = Stages(config, options, frames, (images.shape[2], images.shape[3]), run=inline, mesh=mesh)
    passes, assembly, _ = run_stages(stages, params, ClipInputs(images))
    return assembly, passes
