"""The tables from tensors of PyTorch checkpoints to arrays of the parameter tree, one for each family."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from vggtjax.config import VGGTConfig
from vggtjax.errors import InputError


@dataclass(frozen=True)
class Transform:
    """Transpose to `axes`, then drop leading axes of length 1: a view, and invertible on shapes."""

    axes: tuple[int, ...] | None = None
    drop: int = 0

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return the view of a source tensor for the parameter tree."""
        return (x if self.axes is None else x.transpose(self.axes))[(0,) * self.drop]

    def source_shape(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Return the shape of the source tensor of a target of this shape."""
        shape = (1,) * self.drop + tuple(shape)
        return shape if self.axes is None else tuple(shape[self.axes.index(axis)] for axis in range(len(shape)))


SAME = Transform()
DENSE = Transform((1, 0))  # Linear (out, in) -> kernel (in, out)
CONV = Transform((2, 3, 1, 0))  # Conv2d (out, in, kh, kw) -> kernel (kh, kw, in, out)
POINTWISE = Transform((2, 3, 1, 0), drop=2)  # 1 x 1 Conv2d (out, in, 1, 1) -> dense kernel (in, out)
DEPTH_TO_SPACE = Transform((0, 2, 3, 1))  # ConvTranspose2d (in, out, kh, kw) -> kernel (in, kh, kw, out)
UNBATCHED = Transform(drop=1)  # token table (1, ...) -> (...)
CAMERA = Transform((1, 0, 2))  # camera tokens (1, 2, C) -> (2, 1, C)
TRACKS = Transform((0, 2, 1, 3), drop=2)  # virtual tracks (1, n, 1, C) -> (n, C)


@dataclass(frozen=True)
class Rule:
    """A source name, its target path and transform; `{layer}` in the name numbers axis 0 of the target.

    Two rules with the same path are two names of one parameter.
    """

    source: str
    path: str
    transform: Transform = SAME
    first: int = 0  # number of the target's first layer in the source
    step: int = 1  # between its layers

    @property
    def stacked(self) -> bool:
        """Whether the target stacks all layers, one source tensor each."""
        return "{layer}" in self.source

    def name(self, layer: int) -> str:
        """Return the source name of a layer of the target."""
        return self.source.replace("{layer}", str(self.first + self.step * layer))


Entry = tuple[str, str, Transform]


def _rows(source: str, target: str, *entries: Entry, first: int = 0, step: int = 1) -> list[Rule]:
    return [Rule(source + name, target + path, transform, first, step) for name, path, transform in entries]


def _affine(name: str, path: str, kernel: Transform = DENSE) -> list[Entry]:
    return [(f"{name}.weight", f"{path}.kernel", kernel), (f"{name}.bias", f"{path}.bias", SAME)]


def _norm(name: str, path: str) -> list[Entry]:
    return [(f"{name}.weight", f"{path}.scale", SAME), (f"{name}.bias", f"{path}.bias", SAME)]


_BLOCK = [  # of every transformer
    *_norm("norm1", "norm1"),
    *_norm("norm2", "norm2"),
    *_affine("mlp.fc1", "mlp.fc1"),
    *_affine("mlp.fc2", "mlp.fc2"),
]

_ATTENTION = [
    *_affine("attn.qkv", "attention.qkv"),
    *_affine("attn.proj", "attention.projection"),
    ("ls1.gamma", "scale1", SAME),
    ("ls2.gamma", "scale2", SAME),
]
_DINO_BLOCK = [*_BLOCK, *_ATTENTION]
_QK_NORM = [*_norm("attn.q_norm", "attention.q_norm"), *_norm("attn.k_norm", "attention.k_norm")]
_ALTERNATING_BLOCK = [*_DINO_BLOCK, *_QK_NORM]


def _update_block(attention: str) -> list[Entry]:
    return [
        *_BLOCK,
        (f"{attention}.in_proj_weight", "attention.qkv.kernel", DENSE),
        (f"{attention}.in_proj_bias", "attention.qkv.bias", SAME),
        *_affine(f"{attention}.out_proj", "attention.projection"),
    ]


_SELF_BLOCK = _update_block("attn")
_CROSS_BLOCK = [*_update_block("cross_attn"), *_norm("norm_context", "norm_context")]


def _fusions(suffix: str, target: str) -> list[Entry]:
    """Return the four fusions of a dense head."""
    return [
        row
        for i in range(4)
        for source, path in [(f"scratch.refinenet{i + 1}{suffix}", f"{target}fusion{i}")]
        for row in [
            *(
                convolution
                for unit in (1, 2)[i == 3 :]  # the deepest level fuses no other, and has no first unit
                for c in (1, 2)
                for convolution in _affine(
                    f"{source}.resConfUnit{unit}.conv{c}", f"{path}.residual{unit}.conv{c}", CONV
                )
            ),
            *_affine(f"{source}.out_conv", f"{path}.projection", POINTWISE),
        ]
    ]


_DPT = [
    *_norm("norm", "norm"),
    *(row for i in range(4) for row in _affine(f"projects.{i}", f"projection{i}", POINTWISE)),
    *_affine("resize_layers.0", "features.upsample0", DEPTH_TO_SPACE),
    *_affine("resize_layers.1", "features.upsample1", DEPTH_TO_SPACE),
    *_affine("resize_layers.3", "features.downsample3", CONV),
    *((f"scratch.layer{i + 1}_rn.weight", f"features.level{i}.kernel", CONV) for i in range(4)),
    *_fusions("", "features."),
    *_affine("scratch.output_conv1", "features.output", CONV),
]

_REGRESSION = [
    *_affine("scratch.output_conv2.0", "regression.conv1", CONV),
    *_affine("scratch.output_conv2.2", "regression.conv2", POINTWISE),
]

_TRACKER = "track_head.tracker."
_UPDATE = _TRACKER + "updateformer."

_VGGT: list[Rule] = [
    *_rows(
        "aggregator.patch_embed.",
        "backbone.",
        *_affine("patch_embed.proj", "patch_embedding", CONV),
        ("cls_token", "class_token", UNBATCHED),
        ("register_tokens", "register_tokens", UNBATCHED),
        ("pos_embed", "position_embedding", UNBATCHED),
        *_norm("norm", "norm"),
    ),
    *_rows("aggregator.patch_embed.blocks.{layer}.", "backbone.blocks.", *_DINO_BLOCK),
    *_rows(
        "aggregator.",
        "aggregator.",
        ("camera_token", "camera_token", UNBATCHED),
        ("register_token", "register_tokens", UNBATCHED),
    ),
    *_rows("aggregator.frame_blocks.{layer}.", "aggregator.frame_blocks.", *_ALTERNATING_BLOCK),
    *_rows("aggregator.global_blocks.{layer}.", "aggregator.global_blocks.", *_ALTERNATING_BLOCK),
    *_rows(
        "camera_head.",
        "camera_head.",
        ("empty_pose_tokens", "empty_pose", SAME),
        *_norm("token_norm", "token_norm"),
        *_norm("trunk_norm", "trunk_norm"),
        *_affine("embed_pose", "pose_embedding"),
        *_affine("poseLN_modulation.1", "modulation"),
        *_affine("pose_branch.fc1", "pose_branch.fc1"),
        *_affine("pose_branch.fc2", "pose_branch.fc2"),
    ),
    *_rows("camera_head.trunk.{layer}.", "camera_head.trunk.", *_DINO_BLOCK),
    *_rows("depth_head.", "depth_head.", *_DPT, *_REGRESSION),
    *_rows("point_head.", "point_head.", *_DPT, *_REGRESSION),
    *_rows("track_head.feature_extractor.", "track_head.", *_DPT),
    *_rows(
        _TRACKER,
        "track_head.",
        ("query_ref_token", "query_token", UNBATCHED),
        *_affine("corr_mlp.fc1", "correlation_mlp.fc1"),
        *_affine("corr_mlp.fc2", "correlation_mlp.fc2"),
        *_norm("fmap_norm", "feature_map_norm"),
        *_norm("ffeat_norm", "feature_norm"),
        *_affine("ffeat_updater.0", "feature_update"),
        *_affine("vis_predictor.0", "visibility"),
        *_affine("conf_predictor.0", "confidence"),
    ),
    *_rows(
        _UPDATE,
        "track_head.",
        ("virual_tracks", "virtual_tracks", TRACKS),  # as published
        ("virtual_tracks", "virtual_tracks", TRACKS),  # as spelt
        *_norm("input_norm", "input_norm"),
        *_affine("input_transform", "input_projection"),
        *_norm("output_norm", "output_norm"),
        *_affine("flow_head", "flow_projection"),
    ),
    *_rows(_UPDATE + "time_blocks.{layer}.", "track_head.time_blocks.", *_SELF_BLOCK),
    *_rows(_UPDATE + "space_virtual_blocks.{layer}.", "track_head.virtual_blocks.", *_SELF_BLOCK),
    *_rows(_UPDATE + "space_point2virtual_blocks.{layer}.", "track_head.point_to_virtual_blocks.", *_CROSS_BLOCK),
    *_rows(_UPDATE + "space_virtual2point_blocks.{layer}.", "track_head.virtual_to_point_blocks.", *_CROSS_BLOCK),
]


def _da3(config: VGGTConfig) -> list[Rule]:
    """Return the table of Depth Anything 3, whose blocks are one list: single frames, then pairs."""
    first = config.dino_depth + config.leading_global
    swiglu = [*_affine("mlp.w12", "mlp.fc1"), *_affine("mlp.w3", "mlp.fc2")]
    block = [*_BLOCK[:4], *swiglu, *_ATTENTION] if config.gated_mlp else _DINO_BLOCK
    pair = [*block, *_QK_NORM]
    blocks = "backbone.pretrained.blocks."
    return [
        *_rows(
            "backbone.pretrained.",
            "backbone.",
            *_affine("patch_embed.proj", "patch_embedding", CONV),
            ("cls_token", "class_token", UNBATCHED),
            ("pos_embed", "position_embedding", UNBATCHED),
        ),
        *_rows(
            "backbone.pretrained.", "", ("camera_token", "aggregator.camera_token", CAMERA), *_norm("norm", "tap_norm")
        ),
        *_rows(blocks + "{layer}.", "backbone.blocks.", *block),
        *_rows(f"{blocks}{config.dino_depth}.", "aggregator.leading_block.", *pair),
        *_rows(blocks + "{layer}.", "aggregator.frame_blocks.", *pair, first=first, step=2),
        *_rows(blocks + "{layer}.", "aggregator.global_blocks.", *pair, first=first + 1, step=2),
        *_rows("head.", "depth_head.", *_DPT, *_REGRESSION),
        *_rows(
            "head.",
            "ray_head.",
            *_fusions("_aux", ""),
            *(row for i in range(5) for row in _affine(f"scratch.output_conv1_aux.3.{i}", f"conv{i}", CONV)),
            *_affine("scratch.output_conv2_aux.3.0", "hidden", CONV),
            *_norm("scratch.output_conv2_aux.0.2", "norm"),  # of all four levels; safetensors stores it once
            *_affine("scratch.output_conv2_aux.3.5", "output", POINTWISE),
        ),
        *_rows(
            "cam_dec.",
            "camera_head.",
            *_affine("backbone.0", "fc1"),
            *_affine("backbone.2", "fc2"),
            *_affine("fc_t", "translation"),
            *_affine("fc_qvec", "quaternion"),
            *_affine("fc_fov.0", "field_of_view"),
        ),
        *_rows(
            "cam_enc.",
            "camera_encoder.",
            *_affine("pose_branch.fc1", "pose_branch.fc1"),
            *_affine("pose_branch.fc2", "pose_branch.fc2"),
            *_norm("token_norm", "token_norm"),
            *_norm("trunk_norm", "trunk_norm"),
        ),
        *_rows("cam_enc.trunk.{layer}.", "camera_encoder.trunk.", *_DINO_BLOCK),
    ]


def rules(config: VGGTConfig) -> list[Rule]:
    """Return the table of the configuration's family."""
    if config.family not in IGNORED:
        raise InputError(f"the family {config.family!r} has no table of PyTorch names; expected {', '.join(IGNORED)}")
    return _da3(config) if config.family == "da3" else _VGGT


# What has no use in the network: DINOv2's pre-training; coarser rays, which the public code does not read; Gaussians.
IGNORED = {
    "vggt": re.compile(r"aggregator\.patch_embed\.mask_token"),
    "da3": re.compile(
        r"backbone\.pretrained\.mask_token|head\.scratch\.output_conv1_aux\.[012]\..*"
        r"|head\.scratch\.output_conv2_aux\.[012]\.[05]\..*|gs_head\..*|gs_adapter\..*"
    ),
}
