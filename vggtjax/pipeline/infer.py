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
from vggtjax.method.algorithm import Clips, Masks, check_masks, compute_by, given_masks, run_method
from vggtjax.method.assembly import Assembly, FusionRule, as_tree
from vggtjax.method.passes import Passes
from vggtjax.method.soft_mask import SoftMasking
from vggtjax.network.checkpoint import Model
from vggtjax.network.given import as_images
from vggtjax.network.kernels.frames import Frames
from vggtjax.network.layers import Params
from vggtjax.options import Options
from vggtjax.pipeline.devices import by_frame_padded, replicate

_SLACK = 1e-3  # largest distance of a value from [0, 1] that counts as rounding


def infer(
    params: Params | Model,
    images: Float[Array, "B S H W 3"],
    config: VGGTConfig | None = None,
    *,
    options: Options = Options(),
    masks: Masks = None,
    fusion: FusionRule | None = None,
    motion: MotionConfig | None = None,
    mesh: Mesh | None = None,
    **changes: Any,
) -> tuple[Assembly, Passes]:
    """Run a method on a batch of clips as one compiled function: `run_method` under jit.

    `infer(model, images)` is `infer(model.params, images, model.config)`. For gradients by parameters, or parameters
    that a jit of your own traces, give the tree.

    Args:
        params: the model's parameter tree, or the model.
        images: RGB in [0, 1]; H and W are multiples of the patch size. Floats outside [0, 1] are refused, unless the
            call is traced by jit.
        config: the model's configuration; left out with a model.
        options: how the clips are reconstructed; masks are not refined.
        masks: what moves in each clip, as for `run_method`; mined if None.
        fusion: a rule of fusion, as for `assemble`. A function is compiled anew each time that another one is given:
            bind its weights by `jax.tree_util.Partial(rule, weights)`.
        motion: the table of motion cues; the configuration's own if None.
        mesh: devices along an axis "frames" that share the frames (`frames_mesh`); None for one device.
        changes: fields of `options` by name, such as `method="vggt4d"`.

    Returns:
        The method's depth, confidence and cameras, and the passes they were made of. The mined mask of a clip whose
        frames are all one picture is empty.
    """
    params, config = _network(params, config)
    images, masks = as_images(images), given_masks(masks)
    _check_range(images, "images", "expected RGB in [0, 1]: divide bytes by 255")
    config = config if motion is None else dataclasses.replace(config, motion=motion)
    # Equal programs have equal options: the method's own values are filled in, and masks are not refined here.
    options = dataclasses.replace(options.changed(**changes).resolved(config.motion), refine_mask=False)
    check_masks(masks, images, Frames(mesh))  # before frames are added
    if masks is not None and masks is not False and not isinstance(masks, SoftMasking):
        _check_range(masks, "masks", "expected shares in [0, 1]")
    frames, rule = images.shape[1], as_tree(fusion)
    if mesh is not None:
        masks = masks if masks is None or masks is False else by_frame_padded(masks, mesh)  # type: ignore[arg-type]
        params, images, rule = replicate(params, mesh), by_frame_padded(images, mesh), replicate(rule, mesh)
    all_static = masks is False  # it cannot be traced
    outputs = _infer(params, images, None if all_static else masks, rule, config, options, frames, mesh, all_static)
    return outputs if images.shape[1] == frames else jax.tree.map(lambda x: x[:, :frames], outputs)


def _network(params: Params | Model, config: VGGTConfig | None) -> tuple[Params, VGGTConfig]:
    """Return the parameters and the configuration. Raises InputError for none, or another one than the model's."""
    if isinstance(params, Model):
        if config not in (None, params.config):
            raise InputError("config is not the configuration of the model; leave it out, or give model.params with it")
        return params.params, params.config
    if config is None and isinstance(params, Tracer):
        raise InputError("a model is no argument of jit; close over it, or give model.params and model.config")
    if not isinstance(config, VGGTConfig):
        given = "missing" if config is None else f"a {type(config).__name__}"
        raise InputError(f"config is {given}; give infer(model, images) or infer(model.params, images, model.config)")
    return params, config


def _check_range(values: Array | np.ndarray, name: str, remedy: str) -> None:
    """Raise InputError for values outside [0, 1]; they are unknown while jit traces."""
    if isinstance(values, Tracer) or not values.size or not jnp.issubdtype(values.dtype, jnp.floating):
        return
    library = np if isinstance(values, np.ndarray) else jnp
    with jax.ensure_compile_time_eval():  # also where a caller's jit has closed over them
        low, high = float(library.min(values)), float(library.max(values))
    if not (low >= -_SLACK and high <= 1 + _SLACK):  # so NaN, too, is refused
        raise InputError(f"{name} have values from {low:g} to {high:g}; {remedy}")


@partial(jax.jit, static_argnames=("config", "options", "frames", "mesh", "all_static"))
def _infer(
    params: Params,
    images: Array,
    masks: Masks,
    fusion: FusionRule | None,
    config: VGGTConfig,
    options: Options,
    frames: int,
    mesh: Mesh | None,
    all_static: bool,
) -> tuple[Assembly, Passes]:
    compute = compute_by(options, Frames(mesh, None if mesh is None else frames))
    how = {"masks": False if all_static else masks, "fusion": fusion, "compute": compute}
    assembly, passes = run_method(params, Clips(images, frames=frames), config, options, **how)
    return assembly, passes._replace(matches=None, features=None)
