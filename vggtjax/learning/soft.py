"""The whole method with soft masks: gradients of depth, cameras and points by all parameters of the method."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vggtjax.cameras import Cameras, unproject
from vggtjax.config import Gram, MotionConfig, Threshold, VGGTConfig
from vggtjax.method.fusion_family import FusionParams, fuse, identity, soft_mask
from vggtjax.method.fusion_inputs import observe
from vggtjax.method.mask import CONSTANT, find_threshold, upsample
from vggtjax.method.passes import Passes, first_pass, second_pass
from vggtjax.network.backbone import encode
from vggtjax.network.clip_batch import ClipBatch
from vggtjax.network.layers import Params
from vggtjax.network.pose import decode_pose
from vggtjax.network.precision import Compute, full_precision
from vggtjax.network.suppression import Suppression


class SoftMasking(NamedTuple):
    """Differentiable parameters of the masks; `soft_masking` returns the paper's values."""

    offset: Float[Array, ""]  # added to the threshold tau of the saliency
    temperature: Float[Array, ""]  # T of sigmoid((saliency - tau) / T); 0 for the hard mask
    strength: Float[Array, " depth"]  # of the suppression in every pair, in [0, 1]
    exponents: Float[Array, " cues"]  # of the cues in their product


class SoftReconstruction(NamedTuple):
    """The results of the method with soft masks."""

    depth: Float[Array, "B S H W"]
    log_precision: Float[Array, "B S H W"]
    cameras: Cameras
    points: Float[Array, "B S H W 3"]  # in the world, of pixel centres
    dynamic: Float[Array, "B S H W"]  # dynamic share of each pixel
    passes: Passes


def soft_masking(
    config: VGGTConfig, *, temperature: float = 0.0, mask_pairs: int | None = None, motion: MotionConfig | None = None
) -> SoftMasking:
    """Return the paper's values: no offset to the threshold, suppression in the first pairs, the plain product of cues.

    `motion` is the table of cues, the configuration's own if None. `mask_pairs` is the number of pairs, the table's if
    None.
    """
    motion = motion or config.motion
    return SoftMasking(
        jnp.zeros(()),
        jnp.asarray(temperature, float),
        (jnp.arange(config.depth) < motion.masked_pairs(mask_pairs)).astype(float),
        jnp.ones(len(motion.cues)),
    )


@full_precision
def reconstruct_softly(
    params: Params,
    images: Float[Array, "B S H W 3"],
    config: VGGTConfig,
    masking: SoftMasking,
    fusion: FusionParams | None = None,
    *,
    gram: Gram = "cosine",
    motion: MotionConfig | None = None,
    stop_camera_gradient: bool = True,
    compute_dtype: str = "float32",
    remat: bool = False,
) -> SoftReconstruction:
    """Run 4dvggt-d with soft masks and a fusion rule; temperature 0 and the paper's rule give the method itself.

    Pure: jit with `config`, `gram`, `motion` and the options static. Gradients flow to the masking, the fusion, the
    images and the network's parameters. Gradients that are not requested are not computed: the gradient by `fusion`
    alone never goes back through the network.

    Args:
        params: the model's parameter tree.
        images: RGB in [0, 1].
        config: the model's configuration.
        masking: see `soft_masking`.
        fusion: a tree of the family; the paper's rule if None. Its offset and temperature blend the depths of the
            passes; those of the masking suppress keys.
        gram: similarity of the motion cues.
        motion: the table of cues, and the threshold; the configuration's own if None.
        compute_dtype: type of the blocks' matrix products.
        stop_camera_gradient: as for `forward`.
        remat: compute activations again on the way back, which takes less memory.
    """
    clips = ClipBatch(images, encode(params, images, config, compute_dtype=compute_dtype, remat=remat))
    compute = Compute(compute_dtype, remat=remat)
    mining = {"gram": gram, "motion": motion, "exponents": masking.exponents}
    first, (saliency, _) = first_pass(params, clips, config, compute=compute, **mining)
    threshold = (motion or config.motion).threshold or "otsu"
    dynamic = soft_pixels(saliency, (images.shape[2], images.shape[3]), masking, threshold)
    compute = dataclasses.replace(compute, stop_camera_gradient=stop_camera_gradient)
    suppression = Suppression(strength=masking.strength)
    second = second_pass(params, clips, dynamic, config, suppression=suppression, compute=compute)
    passes = Passes(first, second, saliency, dynamic)  # pyright: ignore[reportArgumentType]
    fused = fuse(identity() if fusion is None else fusion, observe(passes, config.patch_size))
    cameras = Cameras(*decode_pose(second.pose_encoding, (images.shape[2], images.shape[3])))  # pyright: ignore
    points = unproject(fused.depth, cameras.intrinsics, cameras.camera_from_world, pixel_offset=0.5)
    return SoftReconstruction(fused.depth, fused.log_precision, cameras, points, fused.dynamic, passes)


def soft_pixels(
    saliency: Float[Array, "B S h w"], size: tuple[int, int], masking: SoftMasking, threshold: Threshold = "otsu"
) -> Float[Array, "B S H W"]:
    """Return the dynamic share of every pixel; 0 in a clip of constant saliency. `threshold` is the model's."""

    def one_clip(pixels: Float[Array, "S H W"]) -> Float[Array, "S H W"]:
        varies = pixels.max() - pixels.min() >= CONSTANT
        margin = pixels - find_threshold(pixels, threshold) - masking.offset
        is_dynamic = margin >= 0 if threshold == "otsu" else margin > 0  # as `dynamic_pixels`
        return jnp.where(varies, soft_mask(margin, masking.temperature, is_dynamic.astype(margin.dtype)), 0)

    return jax.vmap(one_clip)(upsample(saliency, size))
