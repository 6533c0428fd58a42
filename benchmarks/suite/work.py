"""The work of each part of the network by kind, counted from its shapes alone: two FLOP per multiply-add.

Counted are matrix products, convolutions, exponentials, GELUs and the reading of weights; norms, other activations,
resizing and copies are not. Work divided by ceilings is a floor: a time that no implementation of the same arithmetic
by the same compiler can beat on that machine.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from vggtjax.config import VGGTConfig
from vggtjax.network.heads import camera_head as camera
from vggtjax.network.heads.dpt_head import DENSE_HEADS, HIDDEN
from vggtjax.network.heads.pose import POSE_SIZE

Work = Mapping[str, float]  # kind -> FLOP, functions of a number, or bytes
Grid = tuple[int, int]  # rows and columns of patches

UNITS = {  # kinds of work, and the unit of each
    "linear": "FLOP",  # products with weights in the blocks, in the dtype of the run
    "linear, float32": "FLOP",  # products of the heads and of the cues
    "attention": "FLOP",
    "exp": "exp",
    "GELU": "GELU",
    "convolution": "FLOP",
    "weights": "B",  # read once per use, where few tokens share them
}


def floor_by_kind(parts: Sequence[Work], ceilings: Mapping[str, float]) -> dict[str, float]:
    """Return the least seconds by kind. A part either computes or waits for its weights, whichever takes longer."""
    total: Counter[str] = Counter()
    for part in parts:
        seconds = {kind: amount / ceilings[kind] for kind, amount in part.items()}
        reading = seconds.pop("weights", 0.0)
        total.update(seconds if sum(seconds.values()) >= reading else {"weights": reading})
    return dict(total)


def flop(parts: Sequence[Work]) -> float:
    """Return the floating point operations of all parts, exponentials and GELUs not among them."""
    return sum(amount for part in parts for kind, amount in part.items() if UNITS[kind] == "FLOP")


def backbone(config: VGGTConfig, S: int, grid: Grid) -> list[Work]:
    """Count DINOv2: the patch embedding and its blocks, frame by frame."""
    C, P = config.embed_dim, grid[0] * grid[1]
    embedding = {"linear": 2 * S * P * 3 * config.patch_size**2 * C}
    return [embedding, _blocks(config.dino_depth, S, 1 + config.row.registers + P, C, config.dino_num_heads)]


def alternating(config: VGGTConfig, S: int, grid: Grid) -> list[Work]:
    """Count the pairs of frame and global blocks."""
    C, T = config.embed_dim, config.special_tokens + grid[0] * grid[1]
    return [_blocks(config.depth, count, tokens, C, config.num_heads) for count, tokens in ((S, T), (1, S * T))]


def camera_head(config: VGGTConfig, S: int) -> list[Work]:
    """Count the camera head: a part of its own, since its weights are read in every iteration for S tokens."""
    E, n = config.tap_dim, camera.ITERATIONS
    weights = 12 * config.camera_depth * E**2 + POSE_SIZE * E + 3 * E**2 + E * E // 2 + E // 2 * POSE_SIZE
    blocks = _blocks(config.camera_depth, 1, S, E, config.camera_num_heads)
    rest = {"linear, float32": n * 2.0 * S * weights, "weights": n * 4.0 * weights}
    return [{kind: n * blocks[kind] for kind in ("attention", "exp", "GELU")} | rest]


def depth_head(config: VGGTConfig, S: int, grid: Grid) -> list[Work]:
    """Count a dense head of depth and confidence: what it reads, its DPT, and the last layers at every pixel."""
    (h, w), F, c = grid, config.dpt_features, config.dpt_channels
    P, half = h * w, ((h + 1) // 2) * ((w + 1) // 2)
    sizes = (16 * P, 4 * P, P, half)
    finer, coarsest, pixels = 21 * P, half, P * config.patch_size**2
    linear = 2 * P * 2 * config.embed_dim * sum(c) + 2 * P * (16 * c[0] ** 2 + 4 * c[1] ** 2)
    linear += 2 * F**2 * (finer + coarsest)
    products = 9 * c[3] ** 2 * half + 9 * F * sum(a * b for a, b in zip(c, sizes, strict=True))
    products += 9 * F**2 * (4 * finer + 2 * coarsest) + 9 * F * (F // 2) * 64 * P
    features = {"linear, float32": float(S * linear), "convolution": 2.0 * S * products}
    last = {
        "convolution": 18.0 * S * pixels * (F // 2) * HIDDEN,
        "linear, float32": 2.0 * S * pixels * HIDDEN * DENSE_HEADS["depth"].channels,
    }
    return [features, last]


def cues(config: VGGTConfig, S: int, grid: Grid) -> list[Work]:
    """Count the motion cues: a mean map needs one product per patch, a std map one per pair of patches."""
    P, motion = grid[0] * grid[1], config.motion
    columns = sum(
        len(set(motion.layers(cue, config.depth))) * (P if cue.statistic == "std" else 1) for cue in motion.cues
    )
    return [{"linear, float32": 2.0 * S * P * config.embed_dim * columns}]


def _blocks(layers: int, sequences: int, tokens: int, C: int, heads: int) -> dict[str, float]:
    """Count blocks: the linear layers of every token, and the attention between all."""
    count = 1.0 * layers * sequences
    return {
        "linear": count * 24 * C**2 * tokens,
        "attention": count * 4 * tokens**2 * C,
        "exp": count * heads * tokens**2,
        "GELU": count * 4 * tokens * C,
    }
