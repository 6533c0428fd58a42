"""Motion maps of every pair on clips with known moving pixels, the quality of each map, and which pairs match."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple, get_args, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Float64, Int, Int8

from vggtjax.config import Cue, Gram, MotionConfig, VGGTConfig
from vggtjax.errors import InputError, device_memory_errors
from vggtjax.method.cues import GramCues, Sums, normalise
from vggtjax.network.backbone import patch_grid
from vggtjax.network.kernels.accumulators import Accumulators
from vggtjax.network.layers import Params
from vggtjax.network.model import forward
from vggtjax.progress import Progress, no_progress
from vggtjax.research.calibration.matching import CameBack
from vggtjax.research.evaluation.metrics.masks import auc

GRAMS: tuple[Gram, ...] = ("cosine", "dot")
_COMPARED: tuple[tuple[Literal["q", "k"], Literal["q", "k"]], ...] = (("q", "q"), ("k", "k"), ("q", "k"))
KINDS = tuple(  # every statistic that a cue can have
    Cue(f"{rows}{columns}_{statistic}", rows, columns, (0,), statistic)
    for rows, columns in _COMPARED
    for statistic in get_args(get_type_hints(Cue)["statistic"])
)
STATIC, DYNAMIC, UNCLEAR = 0, 1, -1


class Sweep(NamedTuple):
    """The maps of every pair over clips, and the truth. G counts `GRAMS`, C `KINDS`, L pairs, N clips."""

    maps: Float32[np.ndarray, "G C L N S P"]  # not normalised, so that neighbouring pairs can be averaged
    truth: Int8[np.ndarray, "N S P"]  # STATIC, DYNAMIC or UNCLEAR
    table: MotionConfig  # for comparison with the chosen one: the default cues and floor, the model's own offsets
    table_saliency: Float32[np.ndarray, "G N S P"]
    came_back: Float32[np.ndarray, "L N"]  # share of each pair's matches that come back: see `CameBack`

    @property
    def depth(self) -> int:
        """Number of pairs."""
        return self.maps.shape[2]

    def map(self, gram: Gram, cue: Cue) -> Float32[np.ndarray, "N S P"]:
        """Return a cue's map as in `GramCues`: averaged over its layers, min-max normalised per frame.

        A std is of a single layer: over several, it is not the average of the maps of single layers.
        """
        maps = self.maps[GRAMS.index(gram), kind_index(cue)]
        return np.asarray(normalise(jnp.asarray(sum(maps[layer] for layer in cue.layers) / len(cue.layers))))

    def auc(self) -> Float64[np.ndarray, "G C L"]:
        """Return each map's area under the ROC curve over all clips; the inverted map has 1 minus this area."""
        result = np.empty(self.maps.shape[:3])
        for place in np.ndindex(result.shape):
            result[place] = token_auc(np.asarray(normalise(jnp.asarray(self.maps[place]))), self.truth)
        return result


class SweepSums(NamedTuple):
    """The maps of every pair, and the sums of a table for each similarity."""

    pairs: Int[Array, ""]  # added so far
    maps: Float[Array, "G C L B S P"]
    tables: tuple[Sums, ...]


@dataclass(frozen=True)
class SweepCues:
    """An `Accumulator` of the cues `KINDS` of every pair, and of a table's cues, for both similarities in one pass."""

    table: MotionConfig
    depth: int

    def layer_counts(self) -> np.ndarray:
        """Return int [depth, cues]: how often a cue of the table reads a pair."""
        return self._tables()[0].layer_counts()

    def zeros(self, B: int, S: int, P: int) -> SweepSums:
        """Return empty sums."""
        maps = jnp.zeros((len(GRAMS), len(KINDS), self.depth, B, S, P))
        return SweepSums(jnp.zeros((), jnp.int32), maps, tuple(cues.zeros(B, S, P) for cues in self._tables()))

    def add(
        self,
        sums: SweepSums,
        counts: Int[Array, " cues"],
        q: Float[Array, "B S T N D"],
        k: Float[Array, "B S T N D"],
        frame_count: Int[Array, " B"] | None = None,
    ) -> SweepSums:
        """Store the maps of the next pair, and add the pair to the table's sums."""
        pair, maps, tables = sums
        kinds = MotionConfig(KINDS, self.table.offsets, reference_depth=1)
        once = jnp.ones(len(KINDS), int)
        of_pair = [
            jnp.stack(cues.add(cues.zeros(*maps.shape[3:]), once, q, k, frame_count))
            for cues in (GramCues(kinds, 1, gram) for gram in GRAMS)
        ]
        tables = tuple(
            cues.add(totals, counts, q, k, frame_count) for cues, totals in zip(self._tables(), tables, strict=True)
        )
        return SweepSums(pair + 1, maps.at[:, :, pair].set(jnp.stack(of_pair)), tables)

    def measured(self, sums: SweepSums) -> tuple[Float[Array, "G C L B S P"], Float[Array, "G B S P"]]:
        """Return the maps of every pair, not normalised, and the table's saliency."""
        tables = zip(self._tables(), sums.tables, strict=True)
        return sums.maps, jnp.stack([cues.saliency(totals) for cues, totals in tables])

    def _tables(self) -> list[GramCues]:
        return [GramCues(self.table, self.depth, gram) for gram in GRAMS]


def sweep(
    params: Params,
    clips: Iterable[tuple[Float[np.ndarray, "S H W 3"], Bool[np.ndarray, "S H W"]]],
    config: VGGTConfig,
    *,
    progress: Progress | None = None,
    total: int | None = None,
) -> Sweep:
    """Measure the maps of every pair on clips with known truth.

    One clip at a time is on the device. The maps are on the host: 48 x depth bytes for every token of every clip.

    Args:
        params: the model's parameter tree.
        clips: pictures, RGB in [0, 1], and their dynamic pixels; all clips of one shape.
        config: the model's configuration.
        progress: called with the clips done and `total`.
        total: number of clips, if known.

    Raises:
        InputError: fewer than two clips or two frames, or a model with non-finite maps.
        DeviceMemoryError: a clip does not fit in the device's memory.
    """
    default = MotionConfig()
    kept = {name: getattr(config.motion, name) for name in ("offsets", "mask_pairs", "threshold")}
    table = dataclasses.replace(default, **kept)
    cues = SweepCues(table, config.depth)
    maps, saliencies, truths, shares = [], [], [], []
    for done, (images, mask) in enumerate(clips, 1):
        if len(mask) < 2:
            raise InputError(f"a clip has {len(mask)} frame; expected at least two")
        truths.append(token_truth(np.asarray(mask), config.patch_size))
        with device_memory_errors("fewer frames or a smaller size", *mask.shape):
            measured = jax.device_get(_measure(params, jnp.asarray(images)[None], config, cues))
        clip_maps, saliency, came_back = measured
        if not np.isfinite(clip_maps).all():
            raise InputError("the model's motion maps are not finite; its weights cannot be calibrated")
        maps.append(clip_maps[..., 0, :, :])
        saliencies.append(saliency[:, 0])
        shares.append(came_back[:, 0])
        (progress or no_progress)(done, total)
    if len(maps) < 2:
        raise InputError(f"{len(maps)} clips; expected at least two, one to choose cues and one to confirm them")
    saliency, came_back = np.stack(saliencies, axis=1), np.stack(shares, axis=1)
    return Sweep(np.stack(maps, axis=3), np.stack(truths), table, saliency, came_back)


def kind_index(cue: Cue) -> int:
    """Return the index in `KINDS` of a cue's Gram map and statistic. Raises InputError for one that is not in it."""
    for index, kind in enumerate(KINDS):
        if (kind.rows, kind.columns, kind.statistic) == (cue.rows, cue.columns, cue.statistic):
            return index
    raise InputError(
        f"cue {cue.name!r} is the {cue.statistic} of {cue.rows} with {cue.columns}; the sweep has only "
        f"{', '.join(kind.name for kind in KINDS)}"
    )


def token_truth(mask: Bool[np.ndarray, "S H W"], patch_size: int) -> Int8[np.ndarray, "S P"]:
    """Return DYNAMIC for patches with at least half of their pixels moving, STATIC for none moving, else UNCLEAR."""
    S, H, W = mask.shape
    share = mask.reshape(S, H // patch_size, patch_size, W // patch_size, patch_size).mean(axis=(2, 4)).reshape(S, -1)
    return np.where(share >= 0.5, DYNAMIC, np.where(share == 0, STATIC, UNCLEAR)).astype(np.int8)


def token_auc(values: Float[np.ndarray, "N S P"], truth: Int8[np.ndarray, "N S P"]) -> float:
    """Return the area under the ROC curve over all tokens together, without the unclear ones."""
    known = truth != UNCLEAR
    return float(auc(values[known], truth[known] == DYNAMIC))


@partial(jax.jit, static_argnames=("config", "cues"))
def _measure(
    params: Params, images: Float[Array, "B S H W 3"], config: VGGTConfig, cues: SweepCues
) -> tuple[Float[Array, "G C L B S P"], Float[Array, "G B S P"], Float[Array, "L B"]]:
    together = Accumulators((cues, CameBack(config.depth, patch_grid(images, config))))
    of_cues, came_back = forward(params, images, config, outputs=(), cues=together).cue_sums
    return *cues.measured(of_cues), came_back
