"""Effects of the second pass on the cameras: python -m benchmarks second-pass.

Every dynamic scene has a frozen twin: the same room, camera and textures, with its movers standing still. Plain passes
over both measure the cost of motion. The second pass measures the total effect of suppression on the moving scene, and
its effect without motion on the frozen scene. Another scene's mask measures the effect of losing arbitrary keys;
compared with the frozen scene's own mask it tells whether the movers' keys are worth more.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from rich.console import Console
from rich.progress import Progress as Bars

from benchmarks.summaries import markdown_table
from vggtjax.errors import InputError
from vggtjax.method.mask import dynamic_tokens
from vggtjax.network.checkpoint import Model
from vggtjax.network.heads.pose import decode_pose
from vggtjax.network.model import forward
from vggtjax.options import pairs_to_try
from vggtjax.pipeline.pretrained.load import load_model
from vggtjax.research.evaluation.metrics.trajectory import centre_error, rotation_error
from vggtjax.storage.writing import staging, writing
from vggtjax.training.scenes import SceneConfig, SyntheticClip, held_out_scenes

_forward = jax.jit(forward, static_argnames=("config", "suppress", "outputs"))
_AT_ONCE = 4

Scene = Literal["moving", "frozen"]


class Run(NamedTuple):
    """A pass over all scenes."""

    scene: Scene
    mask: Literal["none", "the movers'", "another scene's"]
    pairs: int  # in which keys are suppressed; 0 in the plain pass


Errors = dict[Run, Float[np.ndarray, "N 2"]]  # rotation in degrees, centres in median depths


def second_pass(
    *,
    model: str = "demo",
    scenes: int = 64,
    frames: int = 12,
    seeds: int = 1,
    pairs: tuple[int, ...] = (1, 2, 3, 5),
    suppress: Literal["zero", "drop"] = "zero",
    out: Path | None = None,
) -> None:
    """Measure errors of the cameras on moving scenes and on their frozen twins, with and without suppressed keys.

    Args:
        model: "demo", or weights as for vggtjax reconstruct.
        scenes: number of held-out dynamic scenes of each draw, at least two.
        frames: frames of a scene.
        seeds: number of draws of scenes.
        pairs: numbers of pairs in which keys are suppressed.
        suppress: how keys are suppressed.
        out: file for the report, in markdown; it is printed only by default.
    """
    if scenes < 2:
        raise InputError(f"scenes is {scenes}; expected at least 2: each scene uses the mask of another")
    if seeds < 1:
        raise InputError(f"seeds is {seeds}; expected at least 1")
    if out is not None:  # what cannot be written fails now
        if out.is_dir():
            raise InputError(f"{out} is a folder; expected the name of a file for the report")
        with staging(out.parent):
            pass
    loaded = load_model(model)
    numbers = pairs_to_try(pairs, loaded.config.depth)
    side = loaded.config.image_size
    config = SceneConfig(height=side, width=side, frames=frames)
    runs = [Run(scene, "none", 0) for scene in ("moving", "frozen")]
    runs += [
        Run(scene, mask, number)
        for number in numbers
        for scene in ("moving", "frozen")
        for mask in ("the movers'", "another scene's")
    ]
    console = Console(stderr=True)
    draws = []
    with Bars(console=console, disable=not console.is_terminal) as bars:
        task = bars.add_task("passes", total=seeds * len(runs))
        for draw in range(seeds):
            errors = {}
            for run, measured in _draw(loaded, config, scenes, draw, runs, suppress):
                errors[run] = measured
                bars.advance(task)
            draws.append(errors)
            if not console.is_terminal:  # a log gets a line for each draw
                console.print(f"scenes of seed {draw}: done", highlight=False)
    errors = {run: np.concatenate([draw[run] for draw in draws]) for run in runs}
    drawn = "seed 0" if seeds == 1 else f"seeds 0 to {seeds - 1}"
    clips = f"{scenes * seeds} scenes ({drawn}) of {frames} frames, {side} x {side} pixels"
    text = report_text(errors, f"Model {loaded.name}, {clips}; keys: {suppress}.")
    Console().print(text, markup=False, highlight=False, soft_wrap=True)
    if out is not None:
        with writing(out) as temporary:
            temporary.write_text(text + "\n")


def _draw(
    model: Model, config: SceneConfig, scenes: int, seed: int, runs: list[Run], suppress: Literal["zero", "drop"]
) -> Iterator[tuple[Run, Float[np.ndarray, "N 2"]]]:
    """Measure every run on one draw of scenes."""
    moving = held_out_scenes("dynamic", scenes, config, seed=seed)
    frozen = held_out_scenes("dynamic", scenes, dataclasses.replace(config, frozen=True), seed=seed)
    for run in runs:
        clips = moving if run.scene == "moving" else frozen
        mask = {
            "none": None,
            "the movers'": clips.dynamic_mask,
            "another scene's": np.roll(clips.dynamic_mask, 1, axis=0),
        }[run.mask]
        yield run, camera_errors(model, clips, mask, run.pairs, suppress)


def camera_errors(
    model: Model,
    clips: SyntheticClip,
    mask: Bool[np.ndarray, "N S H W"] | None,
    pairs: int,
    suppress: Literal["zero", "drop"],
) -> Float[np.ndarray, "N 2"]:
    """Return rotation errors in degrees, and errors of the centres in median depths, of the masked pass over clips."""
    scenes, (height, width), poses = len(clips.images), clips.images.shape[2:4], []
    for start in range(0, scenes, _AT_ONCE):
        some = np.minimum(np.arange(start, start + _AT_ONCE), scenes - 1)
        tokens = None if mask is None else dynamic_tokens(jnp.asarray(mask[some]), model.config.patch_size)
        images = jnp.asarray(clips.images[some], jnp.float32)
        made = _forward(
            model.params, images, model.config, dynamic_tokens=tokens, suppress=suppress,
            mask_pairs=pairs, outputs=("camera",),
        )  # fmt: skip
        poses.append(np.asarray(decode_pose(jnp.asarray(made.pose_encoding), (height, width))[0]))
    found = np.concatenate(poses)[:scenes]
    depth = np.median(clips.depth.reshape(scenes, -1), axis=1)
    errors = [
        [rotation_error(one, true), centre_error(one, true) / unit]
        for one, true, unit in zip(found, clips.camera_from_world, depth, strict=True)
    ]
    return np.array(errors)


def report_text(errors: Errors, heading: str) -> str:
    """Return the heading, a markdown table of all runs, and what follows from them."""
    rows = []
    for run, values in errors.items():
        change = _change(values, errors[run._replace(mask="none", pairs=0)]) if run.pairs else ("", "")
        rotation, centre = values.mean(axis=0)
        pairs = str(run.pairs or "-")
        rows.append([run.scene, run.mask, pairs, f"{rotation:.2f}", change[0], f"{centre:.4f}", change[1]])
    header = ["scene", "keys suppressed", "pairs", "rotation (deg)", "change", "centres / depth", "change"]
    moving, frozen = errors[Run("moving", "none", 0)], errors[Run("frozen", "none", 0)]
    facts = [
        ["moving", "-", "cost of motion: the plain pass, minus that on frozen scenes", *_change(moving, frozen)],
        ["moving", "-", "the same as a share of the plain pass's errors", *_shares(moving - frozen, moving)],
    ]
    compared: list[tuple[Scene, np.ndarray, np.ndarray, str]] = [
        ("moving", moving, moving - frozen, "the cost of motion"),
        ("frozen", frozen, frozen, "the plain pass's errors"),
    ]
    for pairs in sorted({run.pairs for run in errors if run.pairs}):
        for scene, plain, whole, name in compared:
            own, lent = errors[Run(scene, "the movers'", pairs)], errors[Run(scene, "another scene's", pairs)]
            share = _shares(own - plain, whole)
            facts.append([scene, str(pairs), f"change by the movers' mask as a share of {name}", *share])
            facts.append([scene, str(pairs), "another scene's mask, minus the movers'", *_change(lent, own)])
    note = "Changes are against the plain pass on the same scenes; ± is a standard error over scenes."
    told = ["scenes", "pairs", "what", "rotation (deg)", "centres / depth"]
    return "\n\n".join([f"{heading} {note}", markdown_table(header, rows), markdown_table(told, facts)])


def _change(errors: Float[np.ndarray, "N 2"], others: Float[np.ndarray, "N 2"]) -> tuple[str, str]:
    """Return by how much errors are larger than others, with the standard error over scenes, as text."""
    difference = errors - others
    mean, spread = difference.mean(axis=0), difference.std(axis=0, ddof=1) / len(difference) ** 0.5
    return f"{mean[0]:+.2f} ± {spread[0]:.2f}", f"{mean[1]:+.4f} ± {spread[1]:.4f}"


def _shares(part: Float[np.ndarray, "N 2"], whole: Float[np.ndarray, "N 2"]) -> list[str]:
    """Return the ratio of means, with its standard error over scenes, of either error, as text."""
    share = part.mean(axis=0) / whole.mean(axis=0)
    spread = (part - share * whole).std(axis=0, ddof=1) / np.abs(whole.mean(axis=0)) / len(part) ** 0.5
    return [f"{100 * one:+.1f} ± {100 * error:.1f} %" for one, error in zip(share, spread, strict=True)]
