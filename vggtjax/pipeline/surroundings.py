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
    """Compute with 32 bits, with transfers to the device, and without errors of numpy, whatever the program has set.

    That is `jax_enable_x64`, `jax_transfer_guard` and `numpy.seterr`. They hold again after the body. It also decorates
    a function.
    """
    with jax.enable_x64(False), jax.transfer_guard("allow"), np.errstate(**_NUMPY):
        yield
