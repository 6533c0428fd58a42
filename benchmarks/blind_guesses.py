"""Scores of guesses without images on clips with truth, and a model compared with these guesses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Float64
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from vggtjax.cameras import checked_centres
from vggtjax.clips.truth import Truth
from vggtjax.errors import InputError
from vggtjax.progress import Progress
from vggtjax.research.evaluation.ladder import LadderRow
from vggtjax.research.evaluation.metrics.depth import depth_errors, measured
from vggtjax.research.evaluation.metrics.trajectory import from_first, rotation_error
from vggtjax.training.scenes import SceneConfig, generate, load_textures


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

_TOLERANCE = 1e-8  # radians per frame
_FIRST_STEP = 0.02  # radians per frame; first step of the search


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
        InputError: a pixel without depth in every frame.
    """
    known = measured(clips)
    counts = known.sum(axis=(0, 1))
    if not counts.all():
        raise InputError(f"{int((counts == 0).sum())} pixels have no depth in any frame; expected at least one")
    return np.where(known, clips, 0).sum(axis=(0, 1), dtype=np.float64) / counts


def guesses(truth: Truth, prior: Prior) -> list[Guess]:
    """Return the guesses' errors on clips [B, S, ...] of the prior's height and width."""
    return [_guess(clip, truth.clip(clip), prior) for clip in range(len(truth.images))]


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


def still(frames: int) -> Float64[np.ndarray, "S 3 4"]:
    """Return cameras that neither turn nor move."""
    return np.tile(np.eye(3, 4), (frames, 1, 1))


def turning(angular_velocity: Float[np.ndarray, " 3"], frames: int) -> Float64[np.ndarray, "S 3 4"]:
    """Return cameras that turn at a constant rate, R_i = exp(i w), and do not move; w in radians per frame."""
    poses = still(frames)
    turns = np.arange(frames)[:, None] * np.asarray(angular_velocity, np.float64)
    poses[:, :, :3] = Rotation.from_rotvec(turns).as_matrix()
    return poses


def mean_angular_velocity(camera_from_world: Float[np.ndarray, "S 3 4"]) -> Float64[np.ndarray, " 3"]:
    """Return log(R_i R_i-1^T) in radians per frame, averaged over the steps of a trajectory."""
    rotations = Rotation.from_matrix(camera_from_world[:, :, :3])
    return (rotations[1:] * rotations[:-1].inv()).as_rotvec().mean(axis=0)


def best_angular_velocity(truth: Float[np.ndarray, "S 3 4"]) -> Float64[np.ndarray, " 3"]:
    """Return the rate w, radians per frame, whose R_i = exp(i w) has the smallest rotation error against the truth.

    An oracle, because it reads the truth. The best of three searches by Nelder-Mead (the mean angle has kinks): from
    the rate with the truth's last rotation, from the mean of the steps, and from 0.
    """
    rotations = from_first(truth)
    quaternions = rotations.as_quat()  # [S - 1, 4], xyzw
    times = np.arange(1, len(quaternions) + 1)

    def error(rate: Float64[np.ndarray, " 3"]) -> float:
        half = times * np.linalg.norm(rate) / 2
        vector = times[:, None] / 2 * np.sinc(half / np.pi)[:, None] * rate  # of the quaternion of exp(i w)
        cosine = np.abs((quaternions[:, :3] * vector).sum(axis=1) + quaternions[:, 3] * np.cos(half))
        return float(2 * np.arccos(np.minimum(cosine, 1)).mean())

    def descend(start: Float64[np.ndarray, " 3"]) -> tuple[float, Float64[np.ndarray, " 3"]]:
        simplex = start + _FIRST_STEP * np.eye(4, 3, -1)
        options = {"initial_simplex": simplex, "xatol": _TOLERANCE, "fatol": _TOLERANCE, "maxiter": 2000}
        optimum = minimize(error, start, method="Nelder-Mead", options=options)
        return float(optimum.fun), np.asarray(optimum.x, np.float64)

    starts = (rotations[-1].as_rotvec() / len(rotations), mean_angular_velocity(truth), np.zeros(3))
    return min((descend(start) for start in starts), key=lambda optimum: optimum[0])[1]


def still_centre_error(truth: Float[np.ndarray, "S 3 4"]) -> float:
    """Return the RMSE of centres that all coincide: no similarity reduces the spread about their mean."""
    points = checked_centres(truth)
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))


def line_centre_error(truth: Float[np.ndarray, "S 3 4"]) -> float:
    """Return the RMSE of centres on a line at equal steps, after Sim(3) alignment: that of linear regression."""
    points = checked_centres(truth)
    times = np.arange(len(points)) - (len(points) - 1) / 2
    offsets = points - points.mean(axis=0)
    velocity = times @ offsets / (times @ times)
    return float(np.sqrt(((offsets - times[:, None] * velocity) ** 2).sum(axis=1).mean()))
