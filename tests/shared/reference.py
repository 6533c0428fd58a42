"""The aggregator, the Gram maps and multi-Otsu again, slow and obvious: numpy, Python loops, no scan, no cond."""

import jax
import numpy as np
from scipy.special import erf
from skimage.filters import threshold_multiotsu

from vggtjax import VGGTConfig

SPECIAL = 5


def layer_norm(x, weights, epsilon=1e-5):
    mean = x.mean(-1, keepdims=True)
    variance = ((x - mean) ** 2).mean(-1, keepdims=True)
    return (x - mean) / np.sqrt(variance + epsilon) * weights["scale"] + weights["bias"]


def dense(x, weights):
    return x @ weights["kernel"] + weights["bias"]


def rotate(vector, position):
    """Rotate one head's vector [D] by the position (y, x) of its token."""
    out = vector.copy()
    half, quarter = len(vector) // 2, len(vector) // 4
    for axis in range(2):
        for i in range(quarter):
            angle = position[axis] / 100 ** (2 * i / half)
            a, b = axis * half + i, axis * half + quarter + i
            out[a] = vector[a] * np.cos(angle) - vector[b] * np.sin(angle)
            out[b] = vector[b] * np.cos(angle) + vector[a] * np.sin(angle)
    return out


def block(x, weights, heads, positions, suppressed=None, mode="zero"):
    """One transformer block on one sequence [T, C]; returns x, q, k with q, k [T, N, D]."""
    T, C = x.shape
    D = C // heads
    attention = weights["attention"]
    qkv = dense(layer_norm(x, weights["norm1"]), attention["qkv"]).reshape(T, 3, heads, D)
    q, k, v = (qkv[:, i] for i in range(3))
    q, k = layer_norm(q, attention["q_norm"]), layer_norm(k, attention["k_norm"])
    for t in range(T):
        for n in range(heads):
            q[t, n], k[t, n] = rotate(q[t, n], positions[t]), rotate(k[t, n], positions[t])
    out = np.zeros((T, heads, D))
    for n in range(heads):
        keys = k[:, n].copy()
        if suppressed is not None and mode == "zero":
            keys[suppressed] = 0
        logits = q[:, n] @ keys.T / np.sqrt(D)
        if suppressed is not None and mode == "drop":
            logits[:, suppressed] = -np.inf
        weight = np.exp(logits - logits.max(-1, keepdims=True))
        out[:, n] = weight / weight.sum(-1, keepdims=True) @ v[:, n]
    x = x + weights["scale1"] * dense(out.reshape(T, C), attention["projection"])
    hidden = dense(layer_norm(x, weights["norm2"]), weights["mlp"]["fc1"])
    hidden = 0.5 * hidden * (1 + erf(hidden / np.sqrt(2)))
    return x + weights["scale2"] * dense(hidden, weights["mlp"]["fc2"]), q, k


def aggregate(params, patch_tokens, config: VGGTConfig, grid, dynamic=None, mode="zero", mask_pairs=5):
    """One clip [S, P, C] -> the tapped tokens and every global block's q, k of the patches [S, P, N, D]."""
    params = params["aggregator"]
    S, P, C = patch_tokens.shape
    T = SPECIAL + P
    frames = []
    for s in range(S):
        slot = 0 if s == 0 else 1
        frames.append(np.concatenate([params["camera_token"][slot], params["register_tokens"][slot], patch_tokens[s]]))
    x = np.stack(frames).astype(np.float64)
    positions = [(0, 0)] * SPECIAL + [(y + 1, x + 1) for y in range(grid[0]) for x in range(grid[1])]
    taps, q_all, k_all = [], [], []
    for layer in range(config.depth):
        frame_weights, global_weights = (pick(params[name], layer) for name in ("frame_blocks", "global_blocks"))
        keys = np.zeros((S, T), bool)
        masked = dynamic is not None and layer < mask_pairs
        if dynamic is not None and masked:
            keys[:, SPECIAL:] = dynamic.reshape(S, P)
        heads, seen = config.num_heads, keys if masked else [None] * S
        x = np.stack([block(x[s], frame_weights, heads, positions, seen[s], mode)[0] for s in range(S)])
        frame = x
        every = keys.ravel() if masked else None
        flat, q, k = block(x.reshape(S * T, C), global_weights, heads, positions * S, every, mode)
        x = flat.reshape(S, T, C)
        q_all.append(q.reshape(S, T, *q.shape[1:])[:, SPECIAL:])
        k_all.append(k.reshape(S, T, *k.shape[1:])[:, SPECIAL:])
        if layer in config.taps:
            taps.append(np.concatenate([frame, x], axis=-1))
    return taps, np.stack(q_all), np.stack(k_all)


def pick(tree, layer):
    """One layer of a stacked tree."""
    return jax.tree.map(lambda leaf: np.float64(leaf[layer]), tree)


def gram_map(rows, columns, layers, statistic, offsets, gram):
    """One cue over a clip from q or k of every layer [L, S, P, N, D], forming every P x P Gram matrix."""
    _, S, P, N, _ = rows.shape
    result = np.zeros((S, P))
    for r in range(S):
        sources = [r + o for o in offsets if 0 <= r + o < S] or [s for s in range(S) if s != r]
        grams = []
        for layer in layers:
            for s in sources:
                for n in range(N):
                    a, b = rows[layer, r, :, n], columns[layer, s, :, n]
                    if gram == "cosine":
                        a = a / np.linalg.norm(a, axis=-1, keepdims=True)
                        b = b / np.linalg.norm(b, axis=-1, keepdims=True)
                    grams.append(a @ b.T)
        average = np.mean(grams, axis=0)  # [P, P]
        result[r] = average.mean(1) if statistic == "mean" else average.std(1, ddof=1)
    low, high = result.min(1, keepdims=True), result.max(1, keepdims=True)
    return (result - low) / (high - low + 1e-6)


def multi_otsu(values, bins=256):
    """Return the highest threshold of Otsu's best partition into two to four classes, by scikit-image."""
    best, best_score = float(values.max()), -np.inf
    if best - values.min() < 1e-6:
        return best
    distinct = np.count_nonzero(np.histogram(values, bins)[0])
    for classes in range(2, min(4, distinct) + 1):
        thresholds = threshold_multiotsu(values, classes=classes, nbins=bins)
        regions = np.digitize(values, bins=thresholds)
        if len(np.unique(regions)) < classes:
            continue
        score = np.var([values[regions == i].mean() for i in range(classes)]) / classes**0.5
        if score > best_score:
            best, best_score = float(thresholds[-1]), score
    return best
