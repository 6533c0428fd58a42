"""Seeded weights and images: a tensor depends only on its name and shape, so goldens need no weights file."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence

import numpy as np

_TABLES = frozenset(
    {
        "cls_token",
        "pos_embed",
        "pos_emb",
        "register_token",
        "register_tokens",
        "camera_token",
        "mask_token",
        "empty_pose_tokens",
        "query_ref_token",
        "virual_tracks",  # the published name lacks the t
        "virtual_tracks",
    }
)
_WAVES = 6  # in each image
_PERIOD = 32.0  # pixels per unit of the waves' coordinates


def seeded_tensor(name: str, shape: Sequence[int], seed: int = 0) -> np.ndarray:
    """Return the float32 tensor of the PyTorch parameter `name`, scaled so that activations stay of order one.

    Args:
        name: the parameter's full name; its checksum starts the generator.
        shape: PyTorch's layout, such as (out, in) of a linear layer.
        seed: added to the checksum.
    """
    generator = np.random.Generator(np.random.PCG64(zlib.crc32(name.encode()) + seed))
    values = generator.standard_normal(tuple(shape), dtype=np.float32)
    mean, scale = _moments(name, shape)
    if mean is None:
        if ".flow_head." in name:  # small updates keep the tracker's iterations stable
            values *= np.float32(0.1)
        values /= np.float32(scale)
    else:
        values *= np.float32(scale)
        values += np.float32(mean)
    return values


def seeded_state_dict(shapes: Mapping[str, Sequence[int]], seed: int = 0) -> dict[str, np.ndarray]:
    """Return the seeded tensor of every name of `shapes`."""
    return {name: seeded_tensor(name, shape, seed) for name, shape in shapes.items()}


def seeded_images(frames: int, height: int, width: int, seed: int = 0) -> np.ndarray:
    """Return noisy sums of drifting waves: RGB in [0, 1], float32, [frames, 3, height, width] as in PyTorch."""
    generator = np.random.Generator(np.random.PCG64(1_000 + seed))

    def draw(count: int) -> np.ndarray:
        return generator.standard_normal((count, 3, 1, 1), dtype=np.float32)

    rows, columns = np.mgrid[:height, :width].astype(np.float32) / _PERIOD
    time = np.arange(frames, dtype=np.float32)[:, None, None, None]
    images = np.zeros((frames, 3, height, width), np.float32)
    for _ in range(_WAVES):
        vertical, horizontal, phase, drift = (draw(1) for _ in range(4))
        images += np.sin(2.0 * vertical * rows + 2.0 * horizontal * columns + 3.0 * phase + 0.4 * drift * time)
    images += 0.3 * generator.standard_normal(images.shape, dtype=np.float32)
    return np.clip(0.5 + images / 8.0, 0.0, 1.0).astype(np.float32)


def _moments(name: str, shape: Sequence[int]) -> tuple[float | None, float]:
    """Return (mean, scale) of a parameter, or (None, divisor) of a weight matrix or kernel."""
    leaf = name.rpartition(".")[2]
    if leaf == "gamma":  # LayerScale
        return 0.3, 0.05
    if leaf == "bias":
        return 0.0, 0.05
    if leaf in _TABLES or ".time_emb" in name:
        return 0.0, 0.5
    if leaf == "weight" and len(shape) == 1:  # a norm's scale
        return 1.0, 0.1
    transposed = ".resize_layers.0." in name or ".resize_layers.1." in name  # (in, out, kh, kw)
    fan_in = shape[0] if transposed else math.prod(shape[1:])
    return None, math.sqrt(max(fan_in, 1))
