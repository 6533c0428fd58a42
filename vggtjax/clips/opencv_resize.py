"""Pictures resized as Depth Anything 3 was trained on them: OpenCV's rules, area and cubic, in 8 bits."""

from __future__ import annotations

import numpy as np
import scipy.sparse
from jaxtyping import Float32, UInt8

_SLOPE = -0.75  # of OpenCV's cubic kernel at 1


def resized(image: UInt8[np.ndarray, "H W C"], size: tuple[int, int]) -> UInt8[np.ndarray, "h w C"]:
    """Return a picture of `size` (width, height): by the area of its pixels, or by cubics if a side grows."""
    H, W, C = image.shape
    width, height = size
    if (width, height) == (W, H):
        return image
    weights = _cubic if width > W or height > H else _area
    rows, columns = weights(H, height), weights(W, width)
    values = (rows @ image.reshape(H, W * C).astype(np.float32)).reshape(height, W, C)
    values = columns @ values.swapaxes(0, 1).reshape(W, height * C)
    values = values.reshape(width, height, C).swapaxes(0, 1)
    return np.rint(values).clip(0, 255).astype(np.uint8)


def _area(source: int, target: int) -> scipy.sparse.csr_array:
    """Return the share of each pixel of a side in each pixel that covers it."""
    edges = np.arange(target + 1) * (source / target)
    first, last = np.floor(edges[:-1]).astype(int), np.ceil(edges[1:] - 1e-9).astype(int)
    entries = first[:, None] + np.arange((last - first).max())
    inside = np.minimum(entries + 1, edges[1:, None]) - np.maximum(entries, edges[:-1, None])
    return _sparse(entries, inside.clip(0) * (target / source), source)


def _cubic(source: int, target: int) -> scipy.sparse.csr_array:
    """Return the weights of the four pixels around the place of each new one."""
    place = ((np.arange(target) + 0.5) * (source / target) - 0.5).astype(np.float32)
    first = np.floor(place).astype(int)
    distance = np.abs((place - first.astype(np.float32))[:, None] - np.arange(-1, 3, dtype=np.float32))
    near = ((_SLOPE + 2) * distance - (_SLOPE + 3)) * distance**2 + 1
    far = ((distance - 5) * distance + 8) * distance * _SLOPE - 4 * _SLOPE
    weights = np.where(distance <= 1, near, far)
    return _sparse(first[:, None] + np.arange(-1, 3), weights, source)


def _sparse(entries: np.ndarray, weights: np.ndarray, source: int) -> scipy.sparse.csr_array:
    """Return the matrix of weights [target, source]; entries beyond a border are the border's."""
    rows = np.repeat(np.arange(len(entries)), entries.shape[1])
    places = (rows, entries.clip(0, source - 1).ravel())
    matrix: Float32[np.ndarray, ...] = weights.astype(np.float32).ravel()
    return scipy.sparse.csr_array((matrix, places), shape=(len(entries), source))
