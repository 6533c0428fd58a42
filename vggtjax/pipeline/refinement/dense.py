"""Cameras and depths of cells by the clip's own pixels: matched where they are expected, and adjusted, in rounds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Float32, Float64, UInt8

from vggtjax.cameras import Cameras, zoomed
from vggtjax.method.matching.adjustment import Adjustment, Static, adjust
from vggtjax.method.matching.matches import frame_pairs
from vggtjax.pipeline.refinement.cells import Cells, at_scale
from vggtjax.pipeline.refinement.pixel_matches import LEAST_WEIGHT, Window, expected_matches, match_pixels

_ANNEALED = (4.0, 3.0, 2.0, 1.5, 1.0, 1.0, 1.0, 1.0)
_DEPTH_PRIOR = 0.6  # standard deviation of a log depth from the network's, in the rounds
_DAMPING = 1e-5
_SURE = 0.1  # deviation of a measured log depth, up to which it tells the network's error
_FEWEST_SURE = 20
_DEPTHS = (1e-6, 1e6)  # range of a measured depth
_ERRORS = (0.03, 0.3)  # range of the network's error
_CLEARLY = 1.02  # factor of the agreement by which further cameras must be better than the predicted ones


class Round(NamedTuple):
    """Matching, then adjustment."""

    pixels: int  # of a cell in the pictures
    window: Window
    sigma: float  # of the adjustment's loss, in cells


ROUNDS = (
    Round(1, Window(3, 12), 2.0),  # predicted cameras can be off by half a picture
    Round(2, Window(4, 8), 2.0),
    Round(2, Window(4, 6), 1.0),
    Round(4, Window(4, 4), 0.4),
    Round(8, Window(4, 4), 0.16),
    Round(12, Window(6, 3), 0.06),
)


@dataclass(frozen=True)
class CameraPriors:
    """Standard deviations of cameras from where they start; translations are in median depths."""

    rotation: float = float(np.radians(6))
    translation: float = 0.2
    focal: float | None = 0.15  # of the log of one factor; None: intrinsics stay
    fixed: bool = False  # the cameras stay, and their priors are not read


PREDICTED = CameraPriors()
KNOWN = CameraPriors(focal=None, fixed=True)


class DenseWorld(NamedTuple):
    """A static world that the pixels agree with, at P cells."""

    camera_from_world: Float64[np.ndarray, "S 3 4"]
    focal: float  # factor of all focal lengths
    depth: Float32[np.ndarray, "S P"]  # what matches alone say of each, cameras given
    information: Float32[np.ndarray, "S P"]  # inverse variance of its log
    matched: float  # share of the cells with matches
    error: float  # standard deviation of the network's log depth, as far as measured
    parallax: float  # cells by which the middle cell moves in the frame that sees it move most, for a log depth of 1
    zoom: float  # by which matches are further from the middle than one focal length puts them, for each frame of time


@partial(jax.jit, static_argnames=("grid", "priors"))
def _adjust(
    depth: Float[Array, "S P"],
    cameras: Cameras,
    matched: Float[Array, "S M P 2"],
    weight: Float[Array, "S M P"],
    predicted: Float[Array, "S P"],
    sigma: Float[Array, ""],
    grid: tuple[int, int],
    priors: CameraPriors,
) -> Static:
    """Return the adjusted world; `sigma` is traced, so that one program serves all rounds."""
    how = Adjustment(
        sigma=sigma,  # type: ignore[arg-type]
        annealed=_ANNEALED,
        depth_prior=_DEPTH_PRIOR,
        rotation_prior=priors.rotation,
        translation_prior=priors.translation,
        focal_prior=priors.focal,
        fixed_cameras=priors.fixed,
        damping=_DAMPING,
    )
    return adjust(depth, cameras, matched, weight, grid, how, predicted)


def adjust_to_pixels(
    cells: Cells,
    grey: UInt8[np.ndarray, "S H W"],
    priors: CameraPriors,
    rounds: tuple[Round, ...] = ROUNDS,
    on_round: Callable[[], object] = lambda: None,
    starts: Sequence[Float[np.ndarray, "S 3 4"]] = (),
) -> DenseWorld:
    """Return cameras and depths for which cells are seen where the pixels match.

    Args:
        cells: of the result.
        grey: pictures of what its frames show.
        priors: how far the cameras may go from where they are.
        rounds: from coarse to fine.
        on_round: called after each.
        starts: further cameras to start with; those go on that agree best with the matches after the first round.
    """
    depth = cells.depth
    world = nothing = DenseWorld(
        cells.cameras.camera_from_world.astype(np.float64),
        1.0,
        depth,
        np.zeros_like(depth),
        0.0,
        _ERRORS[0],
        parallax=0.0,
        zoom=0.0,
    )
    begun = [_Start(poses.astype(np.float32), depth, 1.0) for poses in (cells.cameras.camera_from_world, *starts)]
    for each in rounds:
        pictures = at_scale(grey, cells.grid, each.pixels)
        fits = [fit for start in begun if (fit := _fit(cells, pictures, start, each, priors)) is not None]
        if fits and np.isfinite((best := _best(fits)).agreement):
            begun, world = [best.start], _measured(cells, best, each)
        else:  # such as windows that are larger than the coarse pictures of a narrow clip, or numbers that overflow
            world = nothing
        on_round()
    return world


class _Start(NamedTuple):
    """Where a round begins."""

    poses: Float32[np.ndarray, "S 3 4"]
    depth: Float32[np.ndarray, "S P"]
    focal: float  # factor of all focal lengths


class _Fit(NamedTuple):
    """What a round found."""

    start: _Start
    pull: Float32[np.ndarray, "S P"]  # to the depths that matches alone say
    information: Float32[np.ndarray, "S P"]
    position: Float32[np.ndarray, "S M P 2"]  # of cells in other frames
    found: Float32[np.ndarray, "S M P 2"]  # where their pixels match
    weight: Float32[np.ndarray, "S M P"]
    agreement: float  # mean over matches of weight / (1 + (distance / sigma)^2); -inf if it is not finite


def _best(fits: Sequence[_Fit]) -> _Fit:
    """Return the fit that agrees best; one of further cameras must agree clearly better than the predicted ones."""
    predicted, *others = fits
    other = max(others, key=lambda fit: fit.agreement, default=predicted)
    return other if other.agreement > max(_CLEARLY * predicted.agreement, predicted.agreement) else predicted


def _fit(
    cells: Cells, pictures: Float32[np.ndarray, "S h w"], start: _Start, each: Round, priors: CameraPriors
) -> _Fit | None:
    """Match and adjust once; None where nothing matches."""
    K = cells.cameras.intrinsics.astype(np.float32)
    cameras = Cameras(start.poses, zoomed(K, start.focal))
    expected, warp = expected_matches(start.depth, cameras, cells.grid)
    found = match_pixels(pictures, expected, warp, cells.grid, each.window, cells.shown)
    weight = found.weight * cells.is_static[:, None]
    if not weight.any():
        return None
    arrays = (start.depth, cameras, found.position, weight, cells.depth, np.float32(each.sigma))
    made: Any = jax.tree.map(np.asarray, _adjust(*arrays, cells.grid, priors))
    after = _Start(made.camera_from_world, made.depth, start.focal * float(made.focal))
    apart = np.sum((found.position - made.position) ** 2, axis=-1)
    agreement = float(np.mean(weight / (1 + apart / each.sigma**2)))
    agreement = agreement if np.isfinite(agreement) else -np.inf
    return _Fit(after, made.pull, made.information, made.position, found.position, weight, agreement)


def _measured(cells: Cells, fit: _Fit, each: Round) -> DenseWorld:
    """Return the world after a round."""
    poses, depth, focal = fit.start
    with np.errstate(over="ignore"):
        measured = np.clip(depth * np.exp(fit.pull), *_DEPTHS)
    cameras = Cameras(poses, zoomed(cells.cameras.intrinsics.astype(np.float32), focal))
    return DenseWorld(
        poses.astype(np.float64),
        focal,
        measured,
        fit.information,
        float((fit.weight.sum(axis=1) > LEAST_WEIGHT).mean()),
        _error(cells.depth, measured, fit.information),
        _parallax(depth, cameras, cells.grid),
        _zoom(fit.found, fit.weight, fit.position, each.sigma, cells.grid),
    )


def _parallax(depth: Float32[np.ndarray, "S P"], cameras: Cameras, grid: tuple[int, int]) -> float:
    """Return how many cells the middle cell moves for a log depth of 1, in the frame that sees it move most."""
    step = np.float32(0.05)
    (nearer, _), (further, _) = (expected_matches(depth * np.exp(by), cameras, grid) for by in (-step, step))
    moved = np.linalg.norm(further - nearer, axis=-1) / (2 * step)
    return float(np.median(np.max(moved * frame_pairs(len(depth)).exist[:, :, None], axis=1)))


def _zoom(
    matched: Float32[np.ndarray, "S M P 2"],
    weight: Float32[np.ndarray, "S M P"],
    position: Float32[np.ndarray, "S M P 2"],
    sigma: float,
    grid: tuple[int, int],
) -> float:
    """Return how much further from the middle of the picture cells match than the world shows them, for each frame.

    A share of their distance from the middle. A lens that zooms leaves it: cameras and depths explain only a part.
    """
    pairs = frame_pairs(len(matched))
    error, place = matched - position, position - np.array(grid[::-1], np.float32) / 2
    weight = weight * pairs.exist[:, :, None] / (1 + np.sum(error**2, axis=-1) / sigma**2) ** 2
    steps = np.array(pairs.offsets, np.float32)[None, :, None]
    grown, size = (np.sum(weight * factor * np.sum(values * place, axis=-1), dtype=np.float64)
                   for values, factor in ((error, steps), (place, steps**2)))  # fmt: skip
    return float(grown / size) if size > 0 else 0.0


def _error(
    predicted: Float32[np.ndarray, "S P"], measured: Float32[np.ndarray, "S P"], information: Float32[np.ndarray, "S P"]
) -> float:
    """Return the standard deviation of the log of predicted depths, by the spread of those that are measured well."""
    ratio = np.log(measured / predicted)[information > _SURE**-2]
    if len(ratio) < _FEWEST_SURE:
        return _ERRORS[0]
    return float(np.clip(np.median(np.abs(ratio - np.median(ratio))) / 0.6745, *_ERRORS))
