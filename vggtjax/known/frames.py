"""The frames of a clip or a result, as far as known geometry depends on them. Does not import jax."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from jaxtyping import Float64

from vggtjax.clips.truth import Placed


class Frames(Placed, Protocol):
    """Frames with their place in the source, names and times: a `Clip` is one, and a `Reconstruction`."""

    @property
    def frame_names(self) -> Sequence[str]: ...

    @property
    def timestamps(self) -> Float64[np.ndarray, " S"] | None: ...  # seconds
