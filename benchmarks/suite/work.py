"""The work of each part of the network by kind, counted from its shapes alone: two FLOP per multiply-add.

Counted are matrix products, convolutions, exponentials, GELUs and the reading of weights; norms, other activations,
resizing and copies are not. Work divided by ceilings is a floor: a time that no implementation of the same arithmetic
by the same compiler can beat on that machine.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from vggtjax.config import VGGTConfig
from vggtjax.network import camera_head as camera
from vggtjax.network import track_head as tracker
from vggtjax.network.aggregator import SPECIAL_TOKENS
from vggtjax.network.backbone import REGISTERS
from vggtjax.network.dpt_head import CHANNELS, HIDDEN
from vggtjax.network.pose import POSE_SIZE

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
    return [embedding, _blocks(config.dino_depth, S, 1 + REGISTERS + P, C, config.dino_num_heads)]


def alternating(config: VGGTConfig, S: int, grid: Grid) -> list[Work]:
    """Count the pairs of frame and global blocks."""
    C, T = config.embed_dim, SPECIAL_TOKENS + grid[0] * grid[1]
    return [_blocks(config.depth, count, tokens, C, config.num_heads) for count, tokens in ((S, T), (1, S * T))]


def camera_head(config: VGGTConfig, S: int) -> list[Work]:
    """Count the camera head: a part of its own, since its weights are read in every iteration for S tokens."""
    E, n = config.tap_dim, camera.ITERATIONS
    weights = 12 * config.camera_depth * E**2 + POSE_SIZE * E + 3 * E**2 + E * E // 2 + E // 2 * POSE_SIZE
    blocks = _blocks(config.camera_depth, 1, S, E, config.camera_num_heads)
    rest = {"linear, float32": n * 2.0 * S * weights, "weights": n * 4.0 * weights}
    return [{kind: n * blocks[kind] for kind in ("attention", "exp", "GELU")} | rest]


def depth_head(config: VGGTConfig, S: int, grid: Grid) -> list[Work]:
    """Count a dense head of depth and confidence, with the projections of what it reads."""
    F, P = config.dpt_features, grid[0] * grid[1]
    pixels = S * P * config.patch_size**2
    last = {
        "convolution": 18.0 * pixels * (F // 2) * HIDDEN,
        "linear, float32": 2.0 * pixels * HIDDEN * CHANNELS["depth"],
    }
    return [_features(config, S, grid, F, F // 2), last]


def cues(config: VGGTConfig, S: int, grid: Grid) -> list[Work]:
    """Count the motion cues: a mean map needs one product per patch, a std map one per pair of patches."""
    P, motion = grid[0] * grid[1], config.motion
    columns = sum(
        len(set(motion.layers(cue, config.depth))) * (P if cue.statistic == "std" else 1) for cue in motion.cues
    )
    return [{"linear, float32": 2.0 * S * P * config.embed_dim * columns}]


def track_head(config: VGGTConfig, S: int, grid: Grid, Q: int) -> list[Work]:
    """Count the tracker of Q points: its feature maps, its correlations, and its transformer."""
    F, C, V, n = config.track_features, config.track_hidden, tracker.VIRTUAL_TRACKS, tracker.ITERATIONS
    levels, radius = config.track_corr_levels, config.track_corr_radius
    E, window, seen = 3 * F + 4, (2 * radius + 2) ** 2, levels * (2 * radius + 1) ** 2
    rows = 2.0 * S * Q * (levels * window * F + seen * C + C * F + E * C + C * (F + 2) + F * F)
    attended = (
        (Q + V, S, S),
        (S, V, Q),
        (S, V, V),
        (S, Q, V),
    )  # over time; virtual to points, virtual, points to virtual
    total = Counter({"linear, float32": rows})
    for sequences, queries, keys in attended:
        total.update(_attended(tracker.LAYERS * sequences, queries, keys, C, tracker.HEADS, "linear, float32"))
    return [_features(config, S, grid, F, F), {kind: n * amount for kind, amount in total.items()}]


def _blocks(layers: int, sequences: int, tokens: int, C: int, heads: int) -> dict[str, float]:
    return _attended(layers * sequences, tokens, tokens, C, heads, "linear")


def _attended(sequences: int, queries: int, keys: int, C: int, heads: int, linear: str) -> dict[str, float]:
    """Count blocks: q, projection and MLP of every query, k and v of every key, and the attention between them."""
    return {
        linear: sequences * 2.0 * C**2 * (10 * queries + 2 * keys),
        "attention": sequences * 4.0 * queries * keys * C,
        "exp": sequences * 1.0 * heads * queries * keys,
        "GELU": sequences * 4.0 * queries * C,
    }


def _features(config: VGGTConfig, S: int, grid: Grid, F: int, out: int) -> dict[str, float]:
    """Count a DPT's projections and reassembly into `out` channels at eight times the grid."""
    (h, w), c = grid, config.dpt_channels
    P, half = h * w, ((h + 1) // 2) * ((w + 1) // 2)
    pixels = (16 * P, 4 * P, P, half)
    finer, coarsest = 21 * P, half
    linear = 2 * P * 2 * config.embed_dim * sum(c) + 2 * P * (16 * c[0] ** 2 + 4 * c[1] ** 2)
    linear += 2 * F**2 * (finer + coarsest)
    products = 9 * c[3] ** 2 * half + 9 * F * sum(a * b for a, b in zip(c, pixels, strict=True))
    products += 9 * F**2 * (4 * finer + 2 * coarsest) + 9 * F * out * 64 * P
    return {"linear, float32": float(S * linear), "convolution": 2.0 * S * products}
