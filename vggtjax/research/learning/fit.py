"""Fitting a family of fusion rules to clips with optax: schedule, early stopping on held-out clips, exact resume."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int
from msgspec import Meta

from vggtjax.errors import InputError, ResultError
from vggtjax.method.fusion.family import PARTS, FusionParams, Observations, fuse, is_free, paper_rule, projected, start
from vggtjax.progress import Progress, no_progress
from vggtjax.research.learning.objectives import (
    View,
    geometric_loss,
    joint_negative_log_likelihood,
    negative_log_likelihood,
    photometric_loss,
)
from vggtjax.storage.arrays import read_arrays, write_arrays
from vggtjax.storage.json_values import Count, check_fields
from vggtjax.storage.versions import source_digest
from vggtjax.storage.writing import writing

Objective = Literal["gaussian", "laplace", "joint", "photometric", "geometric"]
NEEDS_FRAMES = ("photometric", "geometric")  # objectives that compare whole frames; the gate needs whole frames too
HARD_ONLY = ("joint", *NEEDS_FRAMES)  # objectives that would gain by marking badly predicted pixels as moving
_CHUNK = 10  # steps between two evaluations of the held-out clips
_GATE_RATE = 0.3  # of learning, relative to other parts


class FitClips(NamedTuple):
    """C clips of one shape to fit to, or to hold out; scattered pixels are frames of shape [1, N]."""

    seen: Observations  # [C, S, H, W]
    truth: Float[Array, "C S H W"]  # depth; at most 0 where it is unknown
    view: View | None = None  # [C, S, ...], for objectives that compare frames

    @property
    def clips(self) -> int:
        """Number of clips, C."""
        return self.truth.shape[0]

    def taken(self, index: Int[Array, " n"] | Int[np.ndarray, " n"]) -> FitClips:
        """Return the clips of these indices."""
        return jax.tree.map(lambda x: x[index], self)


@dataclass(frozen=True)
class FitConfig:
    """Settings of a fit."""

    family: tuple[str, ...] = ("scale", "power", "floor")
    objective: Objective = "gaussian"
    steps: Count = 300
    learning_rate: Annotated[float, Meta(gt=0, le=10)] = 0.05
    clips_at_once: Count = 8
    patience: Count = 10  # evaluations of the held-out clips without gain after which a fit ends
    decay: Annotated[float, Meta(ge=0, lt=1)] = 1e-4  # of the gate's weights
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(self)
        if unknown := [name for name in self.family if name not in (*PARTS, "gate")]:
            raise InputError(
                f"family has {unknown[0]!r}; expected parts such as parse_family returns: {', '.join(PARTS)}"
            )
        if self.objective in HARD_ONLY and {"offset", "temperature"} & set(self.family):
            raise InputError(f"objective {self.objective!r} does not see soft masks; leave offset and temperature out")


class FitState(NamedTuple):
    """The state from which an interrupted fit resumes exactly."""

    params: FusionParams
    optimiser: Any
    key: Array  # raw data, which can be stored
    step: Int[Array, ""]
    best: FusionParams
    best_loss: Float[Array, ""]  # on the held-out clips
    waited: Int[Array, ""]  # evaluations since the best one
    losses: Float[Array, "L 2"]  # of the fitted and the held-out clips at each evaluation; NaN for later ones


class FitOutcome(NamedTuple):
    """The fitted tree of lowest loss on the held-out clips."""

    params: FusionParams
    held_out_loss: float
    losses: Float[np.ndarray, "L 3"]  # step, loss on the fitted clips, loss on the held-out clips
    stopped_early: bool


def clip_loss(params: FusionParams, clip: FitClips, objective: Objective) -> Float[Array, ""]:
    """Return the objective of one clip (without the axis of clips)."""
    if objective == "joint":
        return joint_negative_log_likelihood(params, clip.seen, clip.truth)
    fused = fuse(params, clip.seen)
    if objective in ("gaussian", "laplace"):
        return negative_log_likelihood(fused, clip.truth, objective)
    if clip.view is None:
        raise InputError(f"objective {objective!r} compares frames; the clips have no pictures and cameras")
    return {"photometric": photometric_loss, "geometric": geometric_loss}[objective](fused, clip.view)


def fit_fusion(
    fitted: FitClips,
    held_out: FitClips,
    config: FitConfig,
    *,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
) -> FitOutcome:
    """Fit the free parts of a family to clips; the other parts stay those of the paper's rule.

    Adam with a cosine schedule over `steps`. The held-out clips are evaluated every 10 steps, and the tree of lowest
    loss there is returned. The paper's rule is evaluated first, and returned unless a later tree is better.

    Args:
        fitted: clips to fit to, at least one.
        held_out: clips that tell when to stop, at least one.
        config: settings of the fit.
        checkpoint: file for the state of every evaluation; a fit of the same settings and clips resumes from the file.
        progress: called with the steps done and their number.

    Raises:
        InputError: no clips, nothing to fit, or a loss that is not finite.
    """
    if not fitted.clips or not held_out.clips:
        raise InputError(f"{fitted.clips} clips to fit to, {held_out.clips} held out; expected at least one of each")
    if not config.family:
        raise InputError("the family has no free part; there is nothing to fit")
    plan = _Plan(config.steps, config.learning_rate, config.decay)
    state = _initial(config, plan)
    free = jax.tree.map(jnp.asarray, is_free(state.params, config.family))
    paper = paper_rule() | ({"gate": state.params["gate"]} if "gate" in state.params else {})
    state = _evaluated(state._replace(params=paper), fitted, held_out, config.objective)._replace(params=state.params)
    _check_finite(state, 0)
    digest = "" if checkpoint is None else _digest(config, fitted, held_out)
    if checkpoint is not None:
        state = _restored(checkpoint, state, digest)
    while int(state.step) < config.steps and int(state.waited) < config.patience:
        at_once = min(config.clips_at_once, fitted.clips)
        state = _advanced(state, free, fitted, config.objective, at_once, plan)
        state = _evaluated(state, fitted, held_out, config.objective)
        _check_finite(state, int(state.step) // _CHUNK)
        if checkpoint is not None:
            _keep(checkpoint, state, digest)
        (progress or no_progress)(min(int(state.step), config.steps), config.steps)
    count = int(state.step) // _CHUNK + 1
    losses = np.column_stack([np.arange(count) * _CHUNK, np.asarray(state.losses)[:count]])
    best = jax.tree.map(np.asarray, state.best)
    return FitOutcome(best, float(state.best_loss), losses, int(state.step) < config.steps)


def _check_finite(state: FitState, evaluation: int) -> None:
    losses = np.asarray(state.losses[evaluation])
    if not np.isfinite(losses).all():
        raise InputError(f"the loss is {losses.tolist()} after {evaluation * _CHUNK} steps; expected finite numbers")


class _Plan(NamedTuple):
    """Settings of the optimiser, traced, so that fits of all plans share a compilation."""

    steps: Array | int
    learning_rate: Array | float
    decay: Array | float


def _optimiser(plan: _Plan) -> optax.GradientTransformation:
    """Return Adam with a short warm-up and half a cosine; each part has its own rate, and the gate's weights decay."""

    def rate(step: Array) -> Array:
        warm = jnp.minimum(1.0, (step + 1) * 20 / plan.steps)
        return plan.learning_rate * warm * (1 + jnp.cos(jnp.pi * jnp.minimum(step / plan.steps, 1.0))) / 2

    def of_gate(tree):
        return {name: jax.tree.map(lambda _, name=name: name == "gate", leaf) for name, leaf in tree.items()}

    def slower(updates, _=None):
        rates = {name: _GATE_RATE if name == "gate" else PARTS[name].rate for name in updates}
        return {name: jax.tree.map(lambda x, name=name: x * rates[name], leaf) for name, leaf in updates.items()}

    schedule: Any = rate
    return optax.chain(
        optax.clip_by_global_norm(10.0),
        optax.scale_by_adam(),
        optax.masked(optax.add_decayed_weights(plan.decay), of_gate),
        optax.stateless(slower),
        optax.scale_by_learning_rate(schedule),
    )


def _initial(config: FitConfig, plan: _Plan) -> FitState:
    params = start(config.family, config.seed)
    key = jax.random.key_data(jax.random.key(config.seed))
    zero = jnp.zeros((), jnp.int32)
    losses = jnp.full((-(-config.steps // _CHUNK) + 1, 2), jnp.nan)
    return FitState(params, _optimiser(plan).init(params), key, zero, params, jnp.asarray(jnp.inf), zero, losses)


@partial(jax.jit, static_argnames=("objective", "at_once"))
def _advanced(
    state: FitState, free: FusionParams, clips: FitClips, objective: Objective, at_once: int, plan: _Plan
) -> FitState:
    optimiser = _optimiser(plan)

    def step(carry, _):
        params, optimiser_state, key = carry
        key, drawn = jax.random.split(key)
        batch = clips.taken(jax.random.choice(drawn, clips.clips, (at_once,), replace=False))

        def add(total, clip):  # one clip's activations at a time
            return jax.tree.map(jnp.add, total, jax.grad(clip_loss)(params, clip, objective)), None

        gradient, _ = jax.lax.scan(add, jax.tree.map(jnp.zeros_like, params), batch)
        gradient = jax.tree.map(lambda g, free: jnp.where(free, g / at_once, 0), gradient, free)
        updates, optimiser_state = optimiser.update(gradient, optimiser_state, params)
        updates = jax.tree.map(lambda u, free: jnp.where(free, u, 0), updates, free)
        moved: Any = optax.apply_updates(params, updates)
        inside = [projected(moved, fitted) for fitted in ((), tuple(PARTS))]
        params = jax.tree.map(lambda free, wide, fit: jnp.where(free, fit, wide), free, *inside)
        return (params, optimiser_state, key), None

    key = jax.random.wrap_key_data(state.key)
    (params, optimiser_state, key), _ = jax.lax.scan(step, (state.params, state.optimiser, key), length=_CHUNK)
    key = jax.random.key_data(key)
    return state._replace(params=params, optimiser=optimiser_state, key=key, step=state.step + _CHUNK)


@partial(jax.jit, static_argnames=("objective",))
def _evaluated(state: FitState, fitted: FitClips, held_out: FitClips, objective: Objective) -> FitState:
    """Return the state with the losses of both sets of clips, and the best tree on the held-out clips."""
    losses = [
        jax.lax.map(lambda clip: clip_loss(state.params, clip, objective), clips).mean() for clips in (fitted, held_out)
    ]
    better: Bool[Array, ""] = losses[1] < state.best_loss
    return state._replace(
        best=jax.tree.map(lambda new, old: jnp.where(better, new, old), state.params, state.best),
        best_loss=jnp.where(better, losses[1], state.best_loss),
        waited=jnp.where(better, 0, state.waited + 1),
        losses=state.losses.at[state.step // _CHUNK].set(jnp.stack(losses)),
    )


def _digest(config: FitConfig, *clips: FitClips) -> str:
    """Return the digest of all that a fit depends on."""
    digest = hashlib.sha256(f"{source_digest()} {config}".encode())
    for leaf in jax.tree.leaves(clips):
        digest.update(str(leaf.shape).encode() + np.asarray(leaf).tobytes())
    return digest.hexdigest()


def _keep(path: Path, state: FitState, digest: str) -> None:
    with writing(path) as temporary:
        leaves = {f"{i:04d}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(state))}
        write_arrays(temporary, leaves | {"digest": np.frombuffer(bytes.fromhex(digest), np.uint8)})


def _restored(path: Path, state: FitState, digest: str) -> FitState:
    """Return the state in a file; `state` itself unless the file holds a whole state of the same fit."""
    try:
        stored = read_arrays(path)
    except ResultError:
        return state
    if stored.pop("digest", np.zeros(0, np.uint8)).tobytes() != bytes.fromhex(digest):
        return state
    leaves, structure = jax.tree.flatten(state)
    read = [stored[name] for name in sorted(stored)]
    if [(new.shape, new.dtype) for new in read] != [(old.shape, old.dtype) for old in leaves]:
        return state
    found = jax.tree.unflatten(structure, [jnp.asarray(leaf) for leaf in read])
    evaluations = range(len(state.losses))
    return found if int(found.step) % _CHUNK == 0 and int(found.step) // _CHUNK in evaluations else state
