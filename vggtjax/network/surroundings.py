"""Settings of jax and numpy that a program makes for its own code, left out of a reconstruction."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import jax
import numpy as np

_NUMPY: dict[str, Any] = {"divide": "warn", "over": "warn", "under": "ignore", "invalid": "warn"}  # its defaults


@contextmanager
def own_settings() -> Iterator[None]:
    """Compute with jax's and numpy's defaults, whatever the program has set; it also decorates a function.

    The settings are `jax_enable_x64`, `jax_numpy_dtype_promotion`, `jax_transfer_guard` and `numpy.seterr`. They are
    the program's again after the body.
    """
    ours = jax.enable_x64(False), jax.numpy_dtype_promotion("standard"), jax.transfer_guard("allow")
    with ours[0], ours[1], ours[2], np.errstate(**_NUMPY):
        yield
