"""The aggregator alone, as a function of the model's parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from vggtjax.config import VGGTConfig
from vggtjax.network.aggregator import Aggregator
from vggtjax.network.backbone import Features
from vggtjax.network.kernels.captured import Capture
from vggtjax.network.layers import Params
from vggtjax.network.precision import full_precision


@full_precision()
def aggregate(
    params: Params,
    features: Any,
    config: VGGTConfig,
    grid: tuple[int, int],
    *,
    captures: Sequence[Capture],
    **options: Any,
) -> Any:
    """Return the camera tokens, the captured taps and the sums, as `Aggregator` does; of patch tokens, too."""
    features = features if isinstance(features, Features) else Features(features)
    return Aggregator(config).apply({"params": params["aggregator"]}, features, grid, captures, **options)
