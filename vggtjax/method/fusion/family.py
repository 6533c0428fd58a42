"""A family of fusion rules with a parameter tree; its default is the paper's rule (4DVGGT-D, stage 3).

Each pass i claims precision_i = exp(scale_i + features) C_i^power_i + floor_i for its depth. The two depths are then
joined by the best linear unbiased estimator of two correlated observations, pixel by pixel:

    w_2 = (v_1 - c) / (v_1 + v_2 - 2 c),    v_i = 1 / precision_i,    c = correlation sqrt(v_1 v_2),
    fused precision = (precision_1 + precision_2 - 2 correlation sqrt(precision_1 precision_2)) / (1 - correlation^2),

which for correlation 0 is inverse-variance weighting. On dynamic pixels the output is that of pass 1. Computations use
logarithms of precisions, so that values and gradients are finite for confidences from 1 to 1e30.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vggtjax.errors import InputError
from vggtjax.method.fusion.gate import apply_gate, init_gate

FusionParams = dict[str, Any]

FEATURES = ("saliency", "depth", "boundary", "dynamic")
_MOST = 80.0  # of exponents: exp(80) is well within float32
_TINY = 1e-30
_COLDEST = 1e-6


class Observations(NamedTuple):
    """The inputs of a rule for every pixel, from two passes; see `observe`."""

    depth1: Float[Array, "*F H W"]
    log_confidence1: Float[Array, "*F H W"]
    depth2: Float[Array, "*F H W"]
    log_confidence2: Float[Array, "*F H W"]
    dynamic: Float[Array, "*F H W"]  # share of the pixel that moves, 0 or 1 for a hard mask
    margin: Float[Array, "*F H W"]  # saliency minus the threshold of the mask
    features: Float[Array, "*F H W K"]  # in the order of FEATURES, of order one


class Fused(NamedTuple):
    """Depth, the logarithm of its precision (inverse variance, in the unit of depth), and the weights of the passes."""

    depth: Float[Array, "*F H W"]
    log_precision: Float[Array, "*F H W"]
    weight: Float[Array, "*F H W"]  # of pass 2 on static pixels
    dynamic: Float[Array, "*F H W"]  # share of pass 1 alone

    @property
    def precision(self) -> Float[Array, "*F H W"]:
        """The precision, limited below overflow."""
        return jnp.exp(jnp.minimum(self.log_precision, _MOST))


@dataclass(frozen=True)
class Part:
    """A leaf of the tree: its shape, its value in the paper's rule, its value at the start of a fit, and its range."""

    shape: tuple[int, ...] = (2,)  # one value for each pass
    paper: float = 0.0
    start: float | None = None  # the paper's value if None; another one where the gradient at that is 0
    low: float = -math.inf
    high: float = math.inf
    least: float | None = None  # lower end of the range during a fit, where the gradient at `low` is 0
    rate: float = 1.0  # of learning, relative to other parts


PARTS: dict[str, Part] = {
    "scale": Part(),  # logarithm of a factor on the precision
    "power": Part(paper=1.0, low=-8, high=8),  # exponent of the confidence
    "floor": Part(start=1e-3, low=0, high=1e6),  # precision added at any confidence
    "saliency": Part(low=-50, high=50),  # change of log precision from saliency 0 to 1
    "depth": Part(low=-50, high=50),  # change of log precision with log depth over the clip's median
    "boundary": Part(low=-50, high=50),  # change of log precision next to the mask's edge
    "dynamic": Part(low=-50, high=50),  # change of log precision on dynamic pixels
    "correlation": Part((), low=-0.99, high=0.99),  # of the two passes' errors
    "inflation": Part((), low=0, high=1e3),  # widens the fused variance by disagreement beyond the claimed variances
    "distrust": Part(low=0, high=1e3),  # discounts a pass by such disagreement
    "offset": Part((), low=-1, high=1, rate=0.1),  # added to the threshold of the saliency
    "temperature": Part((), start=0.1, low=0, high=10, least=1e-3, rate=0.1),  # width of a soft mask's edge; 0: hard
}

PRESETS: dict[str, tuple[str, ...]] = {
    "paper": (),
    "scale": ("scale",),
    "calibrated": ("scale", "power", "floor"),
    "correlated": ("scale", "power", "floor", "correlation"),
    "features": ("scale", "power", "floor", *FEATURES),
    "robust": ("scale", "power", "floor", "correlation", "inflation", "distrust"),
    "soft": ("scale", "power", "floor", "offset", "temperature"),
    "full": tuple(PARTS),
    "gate": ("scale", "power", "floor", "correlation", "gate"),
}


def parse_family(text: str) -> tuple[str, ...]:
    """Return the free parts of a family: a name of `PRESETS`, or parts joined by "+"; InputError for another name."""
    if text in PRESETS:
        return PRESETS[text]
    parts = tuple(dict.fromkeys(part.strip() for part in text.split("+")))
    if unknown := [part for part in parts if part not in (*PARTS, "gate")]:
        raise InputError(
            f"family is {text!r}, and there is no {unknown[0]!r}; expected one of {', '.join(PRESETS)}, or parts such "
            f"as scale+power: {', '.join((*PARTS, 'gate'))}"
        )
    return parts


def paper_rule() -> FusionParams:
    """Return the tree of the paper's rule."""
    return {name: jnp.full(part.shape, part.paper, float) for name, part in PARTS.items()}


def start(family: tuple[str, ...], seed: int = 0) -> FusionParams:
    """Return the tree at the start of a fit: the paper's rule, except for free leaves whose gradient is 0 there.

    `seed` is that of the gate's weights, whose last layer is 0.
    """
    tree = paper_rule()
    for name, part in PARTS.items():
        if name in family and part.start is not None:
            tree[name] = jnp.full(part.shape, part.start, float)
    if "gate" in family:
        tree["gate"] = init_gate(jax.random.split(jax.random.key(seed), len(PARTS) + 1)[0], 4 + len(FEATURES))
    return tree


def projected(params: FusionParams, fitted: tuple[str, ...] = ()) -> FusionParams:
    """Return the tree with every leaf clipped to its range; for `fitted` parts, to the range during a fit."""

    clipped = dict(params)
    for name, part in PARTS.items():
        low = part.least if name in fitted and part.least is not None else part.low
        clipped[name] = jnp.clip(params[name], low, part.high)
    return clipped


def is_free(params: FusionParams, family: tuple[str, ...]) -> FusionParams:
    """Return a tree of booleans of the same structure: True for the free leaves of a family."""
    return {name: jax.tree.map(lambda _, name=name: name in family, leaf) for name, leaf in params.items()}


def check_rule(params: FusionParams) -> None:
    """Raise InputError for a tree with unknown, missing or misshapen parts."""
    names = set(params) - {"gate"}
    if unknown := sorted(names - set(PARTS)):
        raise InputError(f"the rule has {', '.join(unknown)}; expected the parts {', '.join((*PARTS, 'gate'))}")
    if missing := sorted(set(PARTS) - names):
        raise InputError(f"the rule lacks {', '.join(missing)}; start from the parts of paper_rule() or start(family)")
    for name, part in PARTS.items():
        if jnp.shape(params[name]) != part.shape:
            raise InputError(f"part {name} of the rule has shape {jnp.shape(params[name])}; expected {part.shape}")


def fuse(params: FusionParams, seen: Observations) -> Fused:
    """Fuse two passes by a rule of the family, vmapped over frames; any number of leading axes."""
    return _over_frames(_fuse_frame, params, seen)


def log_precisions(params: FusionParams, seen: Observations) -> tuple[Float[Array, "*F H W"], Float[Array, "*F H W"]]:
    """Return the logarithm of the precision that each pass claims, without the discount by disagreement."""
    return _over_frames(_claims, params, seen)


def _over_frames(function: Callable[[FusionParams, Observations], Any], params: FusionParams, seen: Observations):
    for _ in range(seen.depth1.ndim - 2):
        function = jax.vmap(function, in_axes=(None, 0))
    return function(params, seen)


def _claims(params: FusionParams, seen: Observations) -> tuple[Float[Array, "H W"], Float[Array, "H W"]]:
    check_rule(params)
    slopes = jnp.stack([params[name] for name in FEATURES])  # [K, 2]
    shifts = jnp.einsum("hwk,ki->hwi", seen.features, slopes, precision="highest")
    claims = []
    for i, log_confidence in enumerate((seen.log_confidence1, seen.log_confidence2)):
        claim = params["scale"][i] + params["power"][i] * log_confidence + shifts[..., i]
        claims.append(_above(claim, params["floor"][i]))
    if "gate" in params:
        shift = apply_gate(params["gate"], _gate_inputs(seen))
        claims = [claim + shift[..., i] for i, claim in enumerate(claims)]
    return claims[0], claims[1]


def _above(log_precision: Float[Array, "H W"], floor: Float[Array, ""]) -> Float[Array, "H W"]:
    """Return log(exp(log_precision) + floor); its gradient by a floor of 0 is exact unless precision is near 0."""
    near = log_precision > -_MOST
    usual = log_precision + jnp.log1p(floor * jnp.exp(-jnp.where(near, log_precision, 0)))
    low = jnp.where(floor > 0, jnp.logaddexp(log_precision, jnp.log(jnp.where(floor > 0, floor, 1))), log_precision)
    return jnp.where(near, usual, low)


def soft_mask(
    margin: Float[Array, "*S"], temperature: Float[Array, ""], hard: Float[Array, "*S"] | None = None
) -> Float[Array, "*S"]:
    """Return sigmoid(margin / temperature), the share that moves; temperature 0 gives the `hard` mask (margin >= 0)."""
    hard = (margin >= 0).astype(margin.dtype) if hard is None else hard
    soft = jax.nn.sigmoid(margin / jnp.maximum(temperature, _COLDEST))
    return jnp.where(temperature > 0, soft, hard)


def _fuse_frame(params: FusionParams, seen: Observations) -> Fused:
    first, second = _claims(params, seen)
    correlation, apart = params["correlation"], seen.depth2 - seen.depth1
    excess = _excess(first, second, correlation, apart)
    first = first - jnp.log1p(params["distrust"][0] * excess)
    second = second - jnp.log1p(params["distrust"][1] * excess)
    ratio, left = _ratio(first, second, correlation)
    weight1 = jnp.where(first >= second, 1 - correlation * ratio, ratio * (ratio - correlation)) / left
    weight2 = jnp.where(first >= second, ratio * (ratio - correlation), 1 - correlation * ratio) / left
    joined = jnp.maximum(first, second) + jnp.log(left) - jnp.log1p(-correlation * correlation)
    joined = joined - jnp.log1p(params["inflation"] * excess)
    shifted = seen.margin - params["offset"]
    hard = jnp.where(params["offset"] == 0, seen.dynamic, (shifted >= 0).astype(shifted.dtype))
    dynamic = soft_mask(shifted, params["temperature"], hard)
    static = weight1 * seen.depth1 + weight2 * seen.depth2
    depth = dynamic * seen.depth1 + (1 - dynamic) * static
    return Fused(depth, _blended(dynamic, first, joined), weight2, dynamic)


def _blended(
    dynamic: Float[Array, "H W"], first: Float[Array, "H W"], joined: Float[Array, "H W"]
) -> Float[Array, "H W"]:
    """Return the log precision of m D_1 + (1 - m) D_f, variance m^2 v_1 + (1 - m^2) v_f as cov(D_1, D_f) = v_f."""
    widest = jnp.minimum(first, joined)  # log precision of the larger variance
    variances = [jnp.exp(jnp.maximum(widest - own, -_MOST)) for own in (first, joined)]
    return widest - jnp.log(dynamic * dynamic * variances[0] + (1 - dynamic * dynamic) * variances[1])


def _ratio(
    first: Float[Array, "H W"], second: Float[Array, "H W"], correlation: Float[Array, ""]
) -> tuple[Float[Array, "H W"], Float[Array, "H W"]]:
    """Return q, the smaller standard deviation over the larger one, and 1 + q^2 - 2 correlation q."""
    ratio = jnp.exp(-jnp.abs(first - second) / 2)
    return ratio, 1 + ratio * ratio - 2 * correlation * ratio


def _excess(
    first: Float[Array, "H W"], second: Float[Array, "H W"], correlation: Float[Array, ""], apart: Float[Array, "H W"]
) -> Float[Array, "H W"]:
    """Return the excess of the squared difference of the depths over its expectation, relative to that; at least 0.

    For one difference this is chi^2 - 1, so inflation 1 multiplies the variance by the squared Birge ratio.
    """
    _, left = _ratio(first, second, correlation)
    log_expected = jnp.log(left) - jnp.minimum(first, second)  # of the difference's variance
    log_square = jnp.log(apart * apart + _TINY)
    return jnp.maximum(jnp.expm1(jnp.clip(log_square - log_expected, -_MOST, _MOST / 2)), 0)


def _gate_inputs(seen: Observations) -> Float[Array, "H W C"]:
    """Return the inputs of the gate, of order one for any depths and confidences."""
    depths = [jnp.log(jnp.maximum(depth, 1e-6)) for depth in (seen.depth1, seen.depth2)]
    maps = [
        jnp.tanh(seen.log_confidence1 / 4),
        jnp.tanh(seen.log_confidence2 / 4),
        jnp.tanh(depths[1] - depths[0]),
        jnp.tanh(4 * jnp.abs(depths[1] - depths[0])),
    ]
    return jnp.concatenate([jnp.stack(maps, axis=-1), jnp.tanh(seen.features)], axis=-1)
