"""The whole method with soft masks: gradients of depth, cameras and points by all parameters of the method."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

from jaxtyping import Array, Float

from vggtjax.cameras import Cameras, unproject
from vggtjax.config import Gram, MotionConfig, VGGTConfig
from vggtjax.method.algorithm import run_passes
from vggtjax.method.fusion.family import FusionParams, fuse, paper_rule
from vggtjax.method.fusion.inputs import observe
from vggtjax.method.passes import Passes, present
from vggtjax.method.soft_mask import SoftMasking
from vggtjax.network.heads.pose import decode_pose
from vggtjax.network.layers import Params
from vggtjax.network.precision import Compute, full_precision
from vggtjax.options import Options


class SoftReconstruction(NamedTuple):
    """The results of the method with soft masks."""

    depth: Float[Array, "B S H W"]
    log_precision: Float[Array, "B S H W"]
    cameras: Cameras
    points: Float[Array, "B S H W 3"]  # in the world, of pixel centres
    dynamic: Float[Array, "B S H W"]  # dynamic share of each pixel
    passes: Passes


@full_precision()
def reconstruct_soft(
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
    config = config if motion is None else dataclasses.replace(config, motion=motion)
    compute = Compute(compute_dtype, remat=remat, stop_camera_gradient=stop_camera_gradient)
    passes = run_passes(params, images, config, Options(gram=gram), masks=masking, compute=compute)
    fused = fuse(paper_rule() if fusion is None else fusion, observe(passes))
    second = present(passes.second)
    cameras = Cameras(*decode_pose(present(second.pose_encoding), (images.shape[2], images.shape[3])))
    points = unproject(fused.depth, cameras.intrinsics, cameras.camera_from_world, pixel_offset=0.5)
    return SoftReconstruction(fused.depth, fused.log_precision, cameras, points, fused.dynamic, passes)
