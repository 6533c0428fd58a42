"""Fixed hard test scenes: keys and textures that training never draws, selected by their truth."""

from __future__ import annotations

import dataclasses
import functools
from typing import Literal, NamedTuple, get_args

import jax
import numpy as np
from jaxtyping import Bool, Float

from vggtjax.errors import InputError, check_choice, whole_number
from vggtjax.progress import Progress, no_progress
from vggtjax.training.scenes.config import SceneConfig
from vggtjax.training.scenes.render import SyntheticClip, generate
from vggtjax.training.scenes.textures import Textures, load_textures

Kind = Literal["static", "dynamic"]
STREAM = 0x7E57_7E57  # folded into every key; training folds in step numbers, which are far smaller
MIN_FRAMES = 12
MIN_PATH = 0.15  # of the camera's centres, in median depths
MIN_BEND = 0.1  # largest distance of the path from its chord, as a share of its length
MIN_TURN = 10.0  # degrees between two frames of the clip
MIN_SPREAD = 2.0  # 90th to 10th percentile of depth
MIN_LAYERS = 3  # depths at which parts or the room cover at least LAYER_SHARE of the pixels
LAYER_SHARE = 0.03
MOVERS = (0.03, 0.30)  # range of the share of moving pixels, averaged over the frames
SIZE = 48  # pixels of the images that scenes are selected by, whatever the size of the images returned
_AT_ONCE = 16
_MOST_CANDIDATES = 1000  # for each scene; of the default config one in three or four is hard enough


class Hardness(NamedTuple):
    """The difficulty of clips, each field [N]."""

    path: Float[np.ndarray, " N"]
    bend: Float[np.ndarray, " N"]
    turn: Float[np.ndarray, " N"]
    spread: Float[np.ndarray, " N"]
    layers: Float[np.ndarray, " N"]
    movers: Float[np.ndarray, " N"]

    def kept(self, kind: Kind) -> Bool[np.ndarray, " N"]:
        """Return which clips are hard enough for test scenes."""
        hard = (self.path >= MIN_PATH) & (self.bend >= MIN_BEND) & (self.turn >= MIN_TURN)
        hard &= (self.spread >= MIN_SPREAD) & (self.layers >= MIN_LAYERS)
        return hard & (self.movers >= MOVERS[0]) & (self.movers <= MOVERS[1]) if kind == "dynamic" else hard


def held_out_scenes(
    kind: Kind, count: int = 64, config: SceneConfig | None = None, *, seed: int = 0, progress: Progress | None = None
) -> SyntheticClip:
    """Return the test scenes of a seed, with a leading axis of `count`, as numpy arrays.

    Args:
        kind: "static", or "dynamic" with moving objects.
        count: number of scenes; a larger count begins with the scenes of a smaller one.
        config: size and frames; 12 frames of 112 x 112 pixels by default. `kind` replaces its `dynamic`. The selection
            of scenes depends on the other fields, the seed and the kind, not on the image size or `frozen`: it is made
            on square frames.
        seed: of the set; different seeds share no scene.
        progress: called with the number of scenes selected and rendered, and of both: 2 x `count`.

    Raises:
        InputError: an unknown kind, a count below 1, fewer than 12 frames, or a config with hardly any hard scene.
    """
    check_choice("kind of scenes", kind, get_args(Kind))
    count = whole_number("count of scenes", count, 1)
    config = config or SceneConfig(height=112, width=112, frames=MIN_FRAMES)
    if config.frames < MIN_FRAMES:
        raise InputError(f"test scenes have {config.frames} frames; expected at least {MIN_FRAMES}")
    config = dataclasses.replace(config, dynamic=float(kind == "dynamic"))
    textures = load_textures("test")
    keys, tell, clips = _hard_keys(kind, count, config, seed, textures, progress), progress or no_progress, []
    for start in range(0, count, _AT_ONCE):
        clips.append(jax.device_get(_generate(keys[start : start + _AT_ONCE], textures, config)))
        tell(count + min(start + _AT_ONCE, count), 2 * count)
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *clips)


def hardness(clips: SyntheticClip) -> Hardness:
    """Measure the difficulty of clips [N, S, ...] by their truth (numpy)."""
    N = len(clips.depth)
    pose = np.asarray(clips.camera_from_world, np.float64)
    depth = np.asarray(clips.depth, np.float64).reshape(N, -1)
    rotation = pose[..., :3]
    centres = -np.einsum("nsji,nsj->nsi", rotation, pose[..., 3])
    length = np.linalg.norm(np.diff(centres, axis=1), axis=-1).sum(axis=1)
    chord = centres[:, -1:] - centres[:, :1]
    along = chord / np.maximum(np.linalg.norm(chord, axis=-1, keepdims=True), 1e-9)
    away = centres - centres[:, :1]
    away = away - (away * along).sum(axis=-1, keepdims=True) * along
    relative = np.einsum("naij,nbij->nab", rotation, rotation)  # trace of R_a R_b^T
    turn = np.degrees(np.arccos(np.clip((relative.min(axis=(1, 2)) - 1) / 2, -1, 1)))
    low, high = np.percentile(depth, (10, 90), axis=1)
    return Hardness(
        path=length / np.median(depth, axis=1),
        bend=np.linalg.norm(away, axis=-1).max(axis=1) / np.maximum(length, 1e-9),
        turn=turn,
        spread=high / low,
        layers=np.array([_layers(np.asarray(clips.part_ids[n]), depth[n]) for n in range(N)], float),
        movers=np.asarray(clips.dynamic_mask).reshape(N, -1).mean(axis=1),
    )


def _layers(part_ids: np.ndarray, depth: np.ndarray) -> int:
    """Count median depths of parts that cover enough pixels, each at least 1.25 times the next nearer depth."""
    parts, inverse, counts = np.unique(part_ids, return_inverse=True, return_counts=True)
    medians = [np.median(depth.ravel()[inverse.ravel() == i]) for i in range(len(parts))]
    count, last = 0, 0.0
    for median in sorted(m for m, n in zip(medians, counts, strict=True) if n >= LAYER_SHARE * part_ids.size):
        if median >= 1.25 * last:
            count, last = count + 1, median
    return count


def _hard_keys(kind: Kind, count: int, config: SceneConfig, seed: int, textures: Textures, progress):
    """Return the first `count` keys of the seed with hard scenes, measured at a small size."""
    small = dataclasses.replace(config, height=SIZE, width=SIZE, samples=1, exposures=1, frozen=False)
    stream = jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), STREAM), get_args(Kind).index(kind))
    selected, candidate = [], 0
    while len(selected) < count:
        if candidate >= _MOST_CANDIDATES * (1 + len(selected)):
            raise InputError(
                f"{len(selected)} of {candidate} {kind} scenes are hard enough for a test, and {count} are wanted; "
                "choose a config whose cameras move farther"
            )
        keys = jax.vmap(lambda i: jax.random.fold_in(stream, i))(jax.numpy.arange(candidate, candidate + _AT_ONCE))
        hard = hardness(jax.device_get(_generate(keys, textures, small))).kept(kind)
        selected += [keys[i] for i in np.flatnonzero(hard)]
        candidate += _AT_ONCE
        (progress or no_progress)(min(len(selected), count), 2 * count)
    return jax.numpy.stack(selected[:count])


@functools.partial(jax.jit, static_argnums=2)
def _generate(keys, textures: Textures, config: SceneConfig) -> SyntheticClip:
    return jax.vmap(lambda key: generate(key, textures, config))(keys)
