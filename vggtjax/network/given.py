"""Arrays that a caller gives: of jax, of numpy, or of a library whose arrays numpy can read, such as torch."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from vggtjax.errors import InputError, one_line


def as_array(name: str, value: Any) -> Any:
    """Return an array of jax or numpy as it is, and others as an array of numpy.

    Raises InputError for what numpy cannot read, such as a tensor on a GPU, in bfloat16, or with a gradient.
    """
    is_numbers = isinstance(value, np.ndarray) and value.dtype.kind in "biufV"  # V: bfloat16
    if is_numbers or isinstance(value, jax.Array | jax.ShapeDtypeStruct):
        return value
    problem = "no numbers"
    try:
        array = np.asarray(value)
    except Exception as error:  # whatever another library raises
        array, problem = np.empty(0, object), str(error)
    if array.dtype.kind not in "biuf":
        kind = f"{type(value).__module__}.{type(value).__qualname__}".removeprefix("builtins.")
        raise InputError(
            f"{name}: numpy cannot read this {kind} ({one_line(problem, 120)}); expected an array of jax or numpy: "
            "of a tensor give tensor.detach().float().cpu().numpy()"
        )
    return array


def check_floats(images: Any) -> None:
    """Raise InputError for images of whole numbers: bytes would be taken as RGB in [0, 1]."""
    if not jnp.issubdtype(images.dtype, jnp.floating):
        raise InputError(f"images have type {images.dtype}; expected floats in [0, 1]: divide bytes by 255")


def as_images(images: Any) -> Float[Array, "B S H W 3"]:
    """Return images as `as_array` does.

    Raises InputError unless they have five axes, and for NaN and infinity, unless the call is traced by jit.
    """
    given: Any = as_array("images", images)
    if given.ndim != 5:
        remedy = ": of one clip give images[None]" if given.ndim == 4 else ""
        raise InputError(f"images have shape {tuple(given.shape)}; expected [B, S, H, W, 3]{remedy}")
    if _is_known(given) and given.size and jnp.issubdtype(given.dtype, jnp.floating):
        is_finite = np.isfinite(np.asarray(given))  # on the host: nothing is compiled for it
        if not is_finite.all():
            place = ", ".join(map(str, np.argwhere(~is_finite)[0]))
            raise InputError(
                f"images have {np.sum(~is_finite)} values that are NaN or infinite, the first at [{place}]; one of "
                "them would spoil the depth of all frames: repair them, or leave out their frames"
            )
    return given  # pyright: ignore[reportReturnType]: checked where it is used


def _is_known(array: Any) -> bool:
    """Return whether this process has the values of an array."""
    return not isinstance(array, Tracer | jax.ShapeDtypeStruct) and getattr(array, "is_fully_addressable", True)
