"""The table that maps every tensor of a PyTorch VGGT checkpoint to its place in the parameter tree."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Transform = Callable[[np.ndarray], np.ndarray]


def same(x: np.ndarray) -> np.ndarray:
    """Keep the tensor as it is."""
    return x


def dense(x: np.ndarray) -> np.ndarray:
    """Linear (out, in) -> kernel (in, out)."""
    return _axes(x, (1, 0))


def conv(x: np.ndarray) -> np.ndarray:
    """Conv2d (out, in, kh, kw) -> kernel (kh, kw, in, out)."""
    return _axes(x, (2, 3, 1, 0))


def pointwise(x: np.ndarray) -> np.ndarray:
    """1 x 1 Conv2d (out, in, 1, 1) -> dense kernel (in, out)."""
    x = _axes(x, (2, 3, 1, 0))
    if x.shape[:2] != (1, 1):
        raise ValueError("a 1 x 1 kernel")
    return x[0, 0]


def depth_to_space(x: np.ndarray) -> np.ndarray:
    """ConvTranspose2d (in, out, kh, kw) -> kernel (in, kh, kw, out)."""
    return _axes(x, (0, 2, 3, 1))


def unbatched(x: np.ndarray) -> np.ndarray:
    """Token table (1, ...) -> (...)."""
    if x.ndim < 2 or x.shape[0] != 1:
        raise ValueError("a leading axis of length 1")
    return x[0]


def tracks(x: np.ndarray) -> np.ndarray:
    """Virtual tracks (1, n, 1, C) -> (n, C)."""
    return unbatched(_axes(x, (0, 2, 1, 3)))[0]


@dataclass(frozen=True)
class Rule:
    """A source name (regular expression; the group `layer` is an index on axis 0), its target path, its transform."""

    pattern: re.Pattern[str]
    path: str | None  # None: a tensor that is known and not used
    transform: Transform = same


def _rows(source: str, target: str, *entries: tuple[str, str, Transform]) -> list[Rule]:
    return [Rule(re.compile(source + name), f"{target}{path}", transform) for name, path, transform in entries]


def _affine(name: str, path: str, kernel: Transform = dense) -> list[tuple[str, str, Transform]]:
    return [(rf"{name}\.weight", f"{path}.kernel", kernel), (rf"{name}\.bias", f"{path}.bias", same)]


def _norm(name: str, path: str) -> list[tuple[str, str, Transform]]:
    return [(rf"{name}\.weight", f"{path}.scale", same), (rf"{name}\.bias", f"{path}.bias", same)]


_BLOCK = [
    *_norm("norm1", "norm1"),
    *_norm("norm2", "norm2"),
    *_affine(r"attn\.qkv", "attention.qkv"),
    *_norm(r"attn\.q_norm", "attention.q_norm"),
    *_norm(r"attn\.k_norm", "attention.k_norm"),
    *_affine(r"attn\.proj", "attention.projection"),
    (r"ls1\.gamma", "scale1", same),
    (r"ls2\.gamma", "scale2", same),
    *_affine(r"mlp\.fc1", "mlp.fc1"),
    *_affine(r"mlp\.fc2", "mlp.fc2"),
]

_UPDATE_BLOCK = [
    *_norm("norm1", "norm1"),
    *_norm("norm_context", "norm_context"),
    *_norm("norm2", "norm2"),
    (r"(cross_)?attn\.in_proj_weight", "attention.qkv.kernel", dense),
    (r"(cross_)?attn\.in_proj_bias", "attention.qkv.bias", same),
    *_affine(r"(cross_)?attn\.out_proj", "attention.projection"),
    *_affine(r"mlp\.fc1", "mlp.fc1"),
    *_affine(r"mlp\.fc2", "mlp.fc2"),
]

_DPT = [
    *_norm("norm", "norm"),
    *(row for i in range(4) for row in _affine(rf"projects\.{i}", f"projection{i}", pointwise)),
    *_affine(r"resize_layers\.0", "features.upsample0", depth_to_space),
    *_affine(r"resize_layers\.1", "features.upsample1", depth_to_space),
    *_affine(r"resize_layers\.3", "features.downsample3", conv),
    *((rf"scratch\.layer{i + 1}_rn\.weight", f"features.level{i}.kernel", conv) for i in range(4)),
    *(
        row
        for i in range(4)
        for unit in (1, 2)
        for c in (1, 2)
        for row in _affine(
            rf"scratch\.refinenet{i + 1}\.resConfUnit{unit}\.conv{c}", f"features.fusion{i}.residual{unit}.conv{c}", conv
        )
    ),
    *(
        row
        for i in range(4)
        for row in _affine(rf"scratch\.refinenet{i + 1}\.out_conv", f"features.fusion{i}.projection", pointwise)
    ),
    *_affine(r"scratch\.output_conv1", "features.output", conv),
]

_REGRESSION = [
    *_affine(r"scratch\.output_conv2\.0", "regression.conv1", conv),
    *_affine(r"scratch\.output_conv2\.2", "regression.conv2", pointwise),
]

_LAYER = r"\.(?P<layer>\d+)\."
_TRACKER = r"track_head\.tracker\."
_UPDATE = _TRACKER + r"updateformer\."

RULES: list[Rule] = [
    *_rows(
        r"aggregator\.patch_embed\.",
        "backbone.",
        *_affine(r"patch_embed\.proj", "patch_embedding", conv),
        ("cls_token", "class_token", unbatched),
        ("register_tokens", "register_tokens", unbatched),
        ("pos_embed", "position_embedding", unbatched),
        *_norm("norm", "norm"),
    ),
    Rule(re.compile(r"aggregator\.patch_embed\.mask_token"), None),  # DINOv2's pre-training only
    *_rows(r"aggregator\.patch_embed\.blocks" + _LAYER, "backbone.blocks.", *_BLOCK),
    *_rows(
        r"aggregator\.",
        "aggregator.",
        ("camera_token", "camera_token", unbatched),
        ("register_token", "register_tokens", unbatched),
    ),
    *_rows(r"aggregator\.frame_blocks" + _LAYER, "aggregator.frame_blocks.", *_BLOCK),
    *_rows(r"aggregator\.global_blocks" + _LAYER, "aggregator.global_blocks.", *_BLOCK),
    *_rows(
        r"camera_head\.",
        "camera_head.",
        ("empty_pose_tokens", "empty_pose", same),
        *_norm("token_norm", "token_norm"),
        *_norm("trunk_norm", "trunk_norm"),
        *_affine("embed_pose", "pose_embedding"),
        *_affine(r"poseLN_modulation\.1", "modulation"),
        *_affine(r"pose_branch\.fc1", "pose_branch.fc1"),
        *_affine(r"pose_branch\.fc2", "pose_branch.fc2"),
    ),
    *_rows(r"camera_head\.trunk" + _LAYER, "camera_head.trunk.", *_BLOCK),
    *_rows(r"depth_head\.", "depth_head.", *_DPT, *_REGRESSION),
    *_rows(r"point_head\.", "point_head.", *_DPT, *_REGRESSION),
    *_rows(r"track_head\.feature_extractor\.", "track_head.", *_DPT),
    *_rows(
        _TRACKER,
        "track_head.",
        ("query_ref_token", "query_token", unbatched),
        *_affine(r"corr_mlp\.fc1", "correlation_mlp.fc1"),
        *_affine(r"corr_mlp\.fc2", "correlation_mlp.fc2"),
        *_norm("fmap_norm", "feature_map_norm"),
        *_norm("ffeat_norm", "feature_norm"),
        *_affine(r"ffeat_updater\.0", "feature_update"),
        *_affine(r"vis_predictor\.0", "visibility"),
        *_affine(r"conf_predictor\.0", "confidence"),
    ),
    *_rows(
        _UPDATE,
        "track_head.",
        (r"virt?ual_tracks", "virtual_tracks", tracks),  # the published name lacks the t
        *_norm("input_norm", "input_norm"),
        *_affine("input_transform", "input_projection"),
        *_norm("output_norm", "output_norm"),
        *_affine("flow_head", "flow_projection"),
    ),
    *_rows(_UPDATE + "time_blocks" + _LAYER, "track_head.time_blocks.", *_UPDATE_BLOCK),
    *_rows(_UPDATE + "space_virtual_blocks" + _LAYER, "track_head.virtual_blocks.", *_UPDATE_BLOCK),
    *_rows(_UPDATE + "space_point2virtual_blocks" + _LAYER, "track_head.point_to_virtual_blocks.", *_UPDATE_BLOCK),
    *_rows(_UPDATE + "space_virtual2point_blocks" + _LAYER, "track_head.virtual_to_point_blocks.", *_UPDATE_BLOCK),
]


def _axes(x: np.ndarray, order: tuple[int, ...]) -> np.ndarray:
    if x.ndim != len(order):
        raise ValueError(f"{len(order)} axes")
    return x.transpose(order)
