"""Scores of guesses without images on clips with truth, and a model compared with these guesses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Float64

from benchmarks.blind import (
    best_angular_velocity,
    line_centre_error,
    mean_angular_velocity,
    still,
    still_centre_error,
    turning,
)
from vggtjax.clips.truth import Truth
from vggtjax.errors import InputError
from vggtjax.evaluation.ladder import LadderRow
from vggtjax.evaluation.metrics.depth import depth_errors, measured
from vggtjax.evaluation.metrics.trajectory import rotation_error
from vggtjax.progress import Progress
from vggtjax.scenes import SceneConfig, generate, load_textures


class Prior(NamedTuple):
    """Averages of the training scenes."""

    depth: Float64[np.ndarray, "H W"]  # metres
    angular_velocity: Float64[np.ndarray, " 3"]  # radians per frame


@dataclass(frozen=True)
class Guess:
    """Errors of the guesses on one clip, in the units of `LadderRow`."""

    clip: int
    mean_depth_map: float
    no_rotation: float
    mean_rate: float  # the training scenes' mean angular velocity
    best_rate: float  # an oracle: the constant rate with the least error on this clip's truth
    no_motion: float
    line: float  # constant speed along the direction with the least error on this clip's truth


@dataclass(frozen=True)
class Comparison:
    """The model's mean error over clips compared with a guess's."""

    metric: str
    guess: str
    model_error: float | None  # mean over the clips with a number
    guess_error: float
    ratio: float | None
    better: float  # share of the clips with a smaller error of the model
    clips: int
    failed: int  # clips without a number for the model
    threshold: float

    @property
    def passed(self) -> bool:
        return self.failed == 0 and self.ratio is not None and self.ratio <= self.threshold


COMPARED = (  # metric and guess, as fields of LadderRow and Guess; the ratio to stay below
    ("abs_rel", "mean_depth_map", 0.7),
    ("rotation_error", "no_rotation", 0.5),
    ("rotation_error", "mean_rate", 0.5),
    ("rotation_error", "best_rate", 0.5),
    ("centre_error", "no_motion", 0.5),
    ("centre_error", "line", 0.5),
)


def training_prior(config: SceneConfig, scenes: int, *, batch: int = 8, progress: Progress | None = None) -> Prior:
    """Return the mean depth map and the mean angular velocity of `scenes` scenes of the training split."""
    textures = load_textures("training")

    @jax.jit
    def draw(keys, textures):
        clips = jax.vmap(lambda key: generate(key, textures, config))(keys)
        return clips.depth, clips.camera_from_world  # other fields are not computed

    keys = jax.random.split(jax.random.key(0), -(-scenes // batch) * batch)
    total, rates = np.zeros((config.height, config.width)), []
    for start in range(0, scenes, batch):
        count = min(batch, scenes - start)
        depth, poses = (np.asarray(drawn[:count]) for drawn in draw(keys[start : start + batch], textures))
        total += count * mean_depth_map(depth)
        rates += [mean_angular_velocity(trajectory) for trajectory in poses]
        if progress is not None:
            progress(start + count, scenes)
    return Prior(total / scenes, np.mean(rates, axis=0))


def mean_depth_map(clips: Float[np.ndarray, "N S H W"]) -> Float64[np.ndarray, "H W"]:
    """Return the mean known depth of every pixel over the frames of all clips: a guess that sees no image.

    Broadcast to a clip's frames, it is aligned like a prediction.

    Raises:
        InputError: another number of axes than 4, or a pixel without depth in every frame.
    """
    clips = np.asarray(clips)
    if clips.ndim != 4:
        raise InputError(f"depths have shape {clips.shape}; expected clips [N, S, H, W]")
    known = measured(clips)
    counts = known.sum(axis=(0, 1))
    if not counts.all():
        raise InputError(f"{int((counts == 0).sum())} pixels have no depth in any frame; expected at least one")
    return np.where(known, clips, 0).sum(axis=(0, 1), dtype=np.float64) / counts


def guesses(truth: Truth, prior: Prior) -> list[Guess]:
    """Return the guesses' errors on clips [B, S, ...] of the prior's height and width."""
    return [_guess(clip, Truth(*(array[clip] for array in truth)), prior) for clip in range(len(truth.images))]


def compare(rows: Sequence[LadderRow], guessed: Sequence[Guess]) -> list[Comparison]:
    """Compare one method's rows with the guesses on the same clips: the mean error of one over that of the other."""
    found = []
    for metric, guess, threshold in COMPARED:
        pairs = [(getattr(row, metric), getattr(guessed[row.clip], guess)) for row in rows]
        there = np.array([pair for pair in pairs if pair[0] is not None]).reshape(-1, 2)
        ours, theirs = there.mean(axis=0) if len(there) else (None, float(np.mean([pair[1] for pair in pairs])))
        found.append(
            Comparison(
                metric=metric,
                guess=guess,
                model_error=None if ours is None else float(ours),
                guess_error=float(theirs),
                ratio=float(ours / theirs) if ours is not None and theirs > 0 else None,
                better=float((there[:, 0] < there[:, 1]).sum() / len(pairs)),
                clips=len(pairs),
                failed=len(pairs) - len(there),
                threshold=threshold,
            )
        )
    return found


def _guess(clip: int, truth: Truth, prior: Prior) -> Guess:
    poses, frames = truth.camera_from_world, len(truth.images)

    def turned(rate: Float64[np.ndarray, " 3"]) -> float:
        return rotation_error(turning(rate, frames), poses)

    return Guess(
        clip=clip,
        mean_depth_map=depth_errors(np.broadcast_to(prior.depth, truth.depth.shape), truth.depth).abs_rel,
        no_rotation=rotation_error(still(frames), poses),
        mean_rate=turned(prior.angular_velocity),
        best_rate=turned(best_angular_velocity(poses)),
        no_motion=still_centre_error(poses),
        line=line_centre_error(poses),
    )
