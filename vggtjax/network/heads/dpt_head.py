"""DPT head: tapped tokens -> a dense map per frame (VGGT; Vision Transformers for Dense Prediction, 2103.13413)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float

from vggtjax.config import VGGTConfig
from vggtjax.network.heads.resize import resize_aligned
from vggtjax.network.kernels.pieces import largest_divisor
from vggtjax.network.layers import ZEROS, Conv, Conv3x3, Dense, LayerNorm, Params, normal
from vggtjax.network.precision import products, upcast


@dataclass(frozen=True)
class DenseMap:
    """A row of the table of dense heads. A head regresses its values and, as a channel after them, a confidence."""

    module: str  # of the parameter tree
    field: str  # of `Predictions`, without the axis of a single value; `fields` has its confidence too
    values: int  # of a pixel
    activate: Callable[[Array], Array]  # of the values: keeps their shape

    @property
    def channels(self) -> int:
        """What is regressed: values and a confidence logit."""
        return self.values + 1

    @property
    def fields(self) -> tuple[str, str]:
        """The fields of `Predictions` that the head fills: values, confidence."""
        return self.field, f"{self.field}_confidence"


def _signed_expm1(x: Float[Array, ...]) -> Float[Array, ...]:
    return jnp.sign(x) * jnp.expm1(jnp.abs(x))


DENSE_HEADS = {
    "depth": DenseMap("depth_head", "depth", values=1, activate=jnp.exp),
    "points": DenseMap("point_head", "world_points", values=3, activate=_signed_expm1),
}
HIDDEN = 32
PIXELS_AT_ONCE = 4 * 518 * 518  # bounds the memory of the full-resolution maps


class DepthToSpace(nn.Module):
    """Transposed convolution whose stride is its kernel size: every input pixel becomes a separate square."""

    factor: int

    @nn.compact
    def __call__(self, x: Float[Array, "F h w C"]) -> Float[Array, "F H W C"]:
        F, h, w, C = x.shape
        s = self.factor
        kernel = self.param("kernel", normal(C**-0.5), (C, s, s, C))
        bias = self.param("bias", ZEROS, (C,))
        x = jnp.einsum("fhwc,cabo->fhawbo", x, kernel.astype(x.dtype)).reshape(F, h * s, w * s, C)
        return x + bias.astype(x.dtype)[None, None, None]


class ResidualUnit(nn.Module):
    """Two convolutions of relu(x), and a skip that adds x or, as VGGT's published weights were trained, relu(x)."""

    in_place: bool = True

    @nn.compact
    def __call__(self, x: Float[Array, "F h w C"]) -> Float[Array, "F h w C"]:
        C = x.shape[-1]
        positive = nn.relu(x)
        y = nn.relu(Conv3x3(C, name="conv1")(positive))
        return (positive if self.in_place else x) + Conv3x3(C, name="conv2")(y)


class Fusion(nn.Module):
    """Merge a coarser map with a lateral one, and resize the result."""

    in_place: bool = True  # as of `ResidualUnit`

    @nn.compact
    def __call__(
        self, x: Float[Array, "F h w C"], lateral: Float[Array, "F h w C"] | None, size: tuple[int, int]
    ) -> Float[Array, "F H W C"]:
        if lateral is not None:
            x = x + ResidualUnit(self.in_place, name="residual1")(lateral)
        x = ResidualUnit(self.in_place, name="residual2")(x)
        x = Dense(x.shape[-1], name="projection")(x)  # 1 x 1: commutes with the resize, and is cheaper before it
        return resize_aligned(x, size)


class DPTFeatures(nn.Module):
    """Reassemble four projected taps into one map at eight times the patch grid (four levels, coarse to fine)."""

    features: int
    out_features: int
    position_embedding: bool = True
    in_place: bool = True  # as of `ResidualUnit`

    @nn.compact
    def __call__(self, taps: list[Float[Array, "F h w C"]], *, only_levels: bool = False) -> Any:
        """Return the map [F, 8h, 8w, O], or its levels alone, from which another head fuses a map of its own."""
        h, w = taps[0].shape[1:3]
        if self.position_embedding:
            taps = [add_positions(tap, aspect=w / h) for tap in taps]
        levels = [
            DepthToSpace(4, name="upsample0")(taps[0]),
            DepthToSpace(2, name="upsample1")(taps[1]),
            taps[2],
            Conv(taps[3].shape[-1], (3, 3), strides=(2, 2), padding=1, name="downsample3")(taps[3]),
        ]
        levels = [Conv3x3(self.features, use_bias=False, name=f"level{i}")(level) for i, level in enumerate(levels)]
        if only_levels:
            return levels
        return Conv3x3(self.out_features, name="output")(fuse(levels, in_place=self.in_place))


def fuse(levels: list[Float[Array, "F _ _ G"]], *, in_place: bool) -> Float[Array, "F 8h 8w G"]:
    """Return the fusion of levels, coarse to fine; inside a module, which gets four fusions."""
    x = levels[3]
    for i in (3, 2, 1, 0):
        size = levels[i - 1].shape[1:3] if i else (2 * x.shape[1], 2 * x.shape[2])
        x = Fusion(in_place, name=f"fusion{i}")(x, levels[i] if i < 3 else None, size)
    return x


class Regression(nn.Module):
    """Last convolutions at full resolution: features -> values and a confidence logit."""

    channels: int

    @nn.compact
    def __call__(self, x: Float[Array, "F H W C"]) -> Float[Array, "F H W O"]:
        x = nn.relu(Conv3x3(HIDDEN, name="conv1")(x))
        return Dense(self.channels, gain=0.01, name="conv2")(x)  # exp of full-size inputs would overflow


class TapHead(nn.Module):
    """What all heads of dense maps share: a projection of each tap, and a map made of the four.

    A projection is a 1 x 1 convolution after a norm, which the four taps share. Nothing else of a tap is stored.
    """

    config: VGGTConfig

    def setup(self) -> None:
        self.norm = LayerNorm()
        for slot, channels in enumerate(self.config.dpt_channels):
            setattr(self, f"projection{slot}", Dense(channels))

    def project(self, tokens: Float[Array, "... E"], slot: int) -> Float[Array, "... F"]:
        """Return the projection of the tap in `slot`."""
        return getattr(self, f"projection{slot}")(self.norm(tokens))

    def project_all(self, tokens: Float[Array, "B S P E"]) -> list[Float[Array, "B S P F"]]:
        """Return the projections of four equal taps, to declare the parameters."""
        return [self.project(tokens, slot) for slot in range(len(self.config.dpt_channels))]


class DenseHead(TapHead):
    """A dense map and its confidence; arguments as those of `predict_dense`."""

    kind: str = "depth"

    @nn.compact
    def __call__(self, taps: list[Float[Array, "B S P F"]], grid: tuple[int, int]) -> Float[Array, "B S H W O"]:
        """Return values and a confidence logit, before their activation."""
        config, (h, w), p = self.config, grid, self.config.patch_size
        in_place = config.row.relu_in_place
        reassemble = DPTFeatures(config.dpt_features, config.dpt_features // 2, in_place=in_place, name="features")
        regress = Regression(DENSE_HEADS[self.kind].channels, name="regression")

        def some_frames(taps: list[Float[Array, "n P F"]]) -> Float[Array, "n H W O"]:
            features = reassemble([tap.reshape(-1, h, w, tap.shape[-1]) for tap in taps])
            return regress(add_positions(resize_aligned(features, (h * p, w * p)), aspect=w / h))

        out = frames_at_once(some_frames, taps, (h * p) * (w * p))
        return out.reshape(*taps[0].shape[:2], h * p, w * p, DENSE_HEADS[self.kind].channels)

    def declare(self, tokens: Float[Array, "B S P E"], grid: tuple[int, int]) -> None:
        """Read every parameter once."""
        self(self.project_all(tokens), grid)


def project_tap(
    params: Params, tokens: Float[Array, "... E"], slot: int, config: VGGTConfig, precision: str = "highest"
) -> Float[Array, "... F"]:
    """Return a head's projection of the tap in `slot`; nothing else of the tap needs to be stored."""
    with products(precision):
        return TapHead(config).apply({"params": params}, tokens, slot, method="project")  # type: ignore


def predict_dense(
    params: Params,
    taps: list[Float[Array, "B S P F"]],
    config: VGGTConfig,
    grid: tuple[int, int],
    kind: str,
    precision: str = "highest",
) -> tuple[Float[Array, "B S H W V"], Float[Array, "B S H W"]]:
    """Return a dense head's values and confidence (1 + exp(c), at least 1) at full resolution.

    Args:
        params: the head's parameters (`depth_head` or `point_head` of the model's tree).
        taps: outputs of `project_tap` for the four taps.
        config: the model's configuration.
        grid: rows and columns of patches.
        kind: the head's name in `DENSE_HEADS`: "depth" (V = 1, exp(x)) or "points" (V = 3, sign(x) (exp|x| - 1)).
        precision: as in `Compute`.
    """
    with products(precision):
        out: Any = DenseHead(config, kind).apply({"params": params}, taps, grid)
    values, confidence = out[..., :-1], 1 + jnp.exp(out[..., -1])
    return DENSE_HEADS[kind].activate(values), confidence


def frames_at_once(
    some_frames: Callable[[list[Array]], Array], taps: list[Float[Array, "B S P F"]], pixels: int
) -> Float[Array, "BS ..."]:
    """Map `some_frames` over the frames of all clips; `pixels` of a frame decide how many frames are computed at once.

    Frames share the batch axis of the convolutions, and small maps need no loop: inside a loop or a map over single
    frames, the gradient with respect to a kernel is a convolution with only a slow implementation in XLA for CPUs.
    """

    def in_float32(taps: list[Array]) -> Array:
        return some_frames([upcast(tap) for tap in taps])

    frames = [tap.reshape(-1, *tap.shape[2:]) for tap in taps]
    count, most = frames[0].shape[0], max(PIXELS_AT_ONCE // pixels, 1)
    if most >= count:
        return in_float32(frames)
    at_once = largest_divisor(count, most)
    out = jax.lax.map(in_float32, [tap.reshape(-1, at_once, *tap.shape[1:]) for tap in frames])
    return out.reshape(count, *out.shape[2:])


def add_positions(x: Float[Array, "F h w C"], aspect: float, weight: float = 0.1) -> Float[Array, "F h w C"]:
    """Add a sinusoidal embedding of the position on the image plane, whose diagonal has length 2."""
    h, w, C = x.shape[1:]
    diagonal = (1 + aspect**2) ** 0.5
    u, v = (
        np.linspace(-span * (n - 1) / n, span * (n - 1) / n, n)
        for span, n in ((aspect / diagonal, w), (1 / diagonal, h))
    )
    frequencies = 1.0 / 100.0 ** (np.arange(C // 4) / (C / 4))

    def waves(position):
        angles = position[:, None] * frequencies
        return np.concatenate([np.sin(angles), np.cos(angles)], axis=-1)

    zeros = np.zeros((1, C // 2))  # a constant of the map's size would add hundreds of megabytes to the program
    across = np.concatenate([waves(u), np.repeat(zeros, w, axis=0)], axis=-1)  # [w, C]
    down = np.concatenate([np.repeat(zeros, h, axis=0), waves(v)], axis=-1)  # [h, C]
    return x + jnp.asarray(weight * across, x.dtype)[None, None] + jnp.asarray(weight * down, x.dtype)[None, :, None]
