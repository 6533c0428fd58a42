"""How the network is computed: the blocks' type, and how exact float32 products are on accelerators."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vggtjax.config import Attention, ComputeDType, Precision, Reference
from vggtjax.errors import InputError, check_choice
from vggtjax.network.kernels.frames import Frames


@dataclass(frozen=True)
class Compute:
    """How the network is computed; static under jit.

    Attributes:
        compute_dtype: "float32" or "bfloat16" for the matrix products of the blocks, the camera head's among them;
            norms, residuals and the rest of the heads are float32.
            "float64" is for checks of gradients; it requires parameters and images in float64 and jax.enable_x64.
        precision: of the products of the dense heads and of the motion cues on accelerators: "highest" for float32;
            "tf32" as PyTorch computes convolutions on an NVIDIA GPU (on a TPU, three passes in bfloat16). What the
            camera head multiplies outside of its blocks is float32 always.
        remat: compute activations of blocks and dense heads again in the backward pass: less memory, more time.
        stop_camera_gradient: treat the previous estimate as a constant in every iteration of the camera head, as in
            VGGT's training.
        attention: how global attention is computed: "exact", "sampled" (an approximation, see
            `network.kernels.sampled`), or a function (S, grid, special tokens) -> attention, as an experiment.
        reference: the frame with the first camera token, in families that choose one: "chosen" by their rule, "first"
            or "middle" of the clip.
        frames: where the frames of the clips are; all here by default, else the call is inside `Frames.on_devices`.
    """

    compute_dtype: str = "float32"
    precision: str = "highest"
    remat: bool = False
    stop_camera_gradient: bool = True
    attention: str | Callable = "exact"
    reference: str = "chosen"
    frames: Frames = Frames()

    def __post_init__(self) -> None:
        check_compute_dtype(self.compute_dtype)
        check_choice("precision", self.precision, get_args(Precision))
        check_choice("reference", self.reference, get_args(Reference))
        if not callable(self.attention):
            check_choice("attention", self.attention, get_args(Attention))


def check_compute_dtype(name: str) -> None:
    """Raise InputError for a type in which the blocks cannot be computed."""
    check_choice("compute_dtype", name, get_args(ComputeDType))
    if name == "float64" and not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise InputError("compute_dtype is 'float64', which requires jax.enable_x64(True)")


def upcast(x: Float[Array, "*S"]) -> Float[Array, "*S"]:
    """Return x in float32, or unchanged in float64: the types of sums and residual streams."""
    return x.astype(jnp.promote_types(x.dtype, jnp.float32))


def products(precision: str) -> AbstractContextManager[None]:
    """Return a context in which float32 products are traced with `Compute.precision`."""
    return jax.default_matmul_precision("tensorfloat32" if precision == "tf32" else "highest")


@contextmanager
def full_precision() -> Iterator[None]:
    """Trace with every matrix product and convolution at the highest precision (never TF32); decorates functions.

    Types are promoted as jax does by default, whatever the program has set: weights in bfloat16 meet float32. The
    settings hold only while a function is traced; nothing global changes.
    """
    with jax.default_matmul_precision("highest"), jax.numpy_dtype_promotion("standard"):
        yield
